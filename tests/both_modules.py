"""The kernels for AVX2 and FMA, and those for any processor: the bits must be the same."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import numpy as np
import pytest

from cdmisfa import kernels
from cdmisfa.kernels import _plain, _wide


@contextmanager
def using(module: Any) -> Iterator[None]:
    """Compute with one of the two."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernels, "lib", module.lib)
        patch.setattr(kernels, "ffi", module.ffi)
        patch.setattr(kernels, "_buffer", module.ffi.from_buffer)
        yield


def both_modules() -> list[AbstractContextManager[None]]:
    """Each in turn; where this processor has no AVX2, the second is all there is."""
    return [using(module) for module in ((_wide, _plain) if kernels.WIDE else (_plain, _plain))]


def assert_same_bits(first: Any, second: Any) -> None:
    """One NaN is as good as another: which one comes of an operation is the processor's choice."""
    for one, other in zip(first, second, strict=True):
        a, b = (np.asarray(x) for x in (one, other))
        same = a.view(f"u{a.itemsize}") == b.view(f"u{b.itemsize}")
        assert (same | (np.isnan(a) & np.isnan(b))).all()
