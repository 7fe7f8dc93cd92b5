"""Compiled functions where nothing can be kept on disk."""

from __future__ import annotations

from types import SimpleNamespace

import numba
import pytest

from cdmisfa.core.compiled import compiled, needs_compiling


def test_without_a_folder_for_results_it_compiles_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def no_folder(**options: object) -> object:
        if options.pop("cache", False):
            raise RuntimeError("cannot cache function: no locator available")
        return numba.njit(**options)

    monkeypatch.setattr("cdmisfa.core.compiled.numba", SimpleNamespace(njit=no_folder))

    @compiled
    def double(x: float) -> float:
        return 2.0 * x

    assert needs_compiling(double)
    assert double(1.5) == 3.0
    assert not needs_compiling(double)
