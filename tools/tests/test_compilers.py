"""The bits of the kernels by optimising compilers, sanitizers and emulated processors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.test_bits import NEHALEM, assert_same_bits

pytestmark = pytest.mark.system  # clang, and emulated processors

WIDE = ("-O3", "-mavx2", "-mfma")
SANITIZERS = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


@pytest.mark.parametrize(
    ("compiler", "flags", "runner"),
    [
        (("gcc",), ("-O3",), ()),
        (("gcc",), WIDE, ()),
        (("gcc",), SANITIZERS, ()),
        (("gcc",), (*WIDE, *SANITIZERS), ()),
        (("gcc",), ("-O3", "-static"), NEHALEM),
        (("clang",), WIDE, ()),
        (("aarch64-linux-gnu-gcc",), ("-O3", "-static"), ("qemu-aarch64",)),
    ],
    ids=" ".join,
)
def test_bits_are_the_same(
    compiler: Sequence[str], flags: Sequence[str], runner: Sequence[str], tmp_path: Path
) -> None:
    assert_same_bits(compiler, flags, runner, tmp_path)
