"""Compiled functions, and what is kept of them on disk."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numba
import pytest

from cdmisfa.core.arithmetic.compiled import MARKS, compiled, needs_compiling


def test_without_a_folder_for_results_it_compiles_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def no_folder(**options: object) -> object:
        if options.pop("cache", False):
            raise RuntimeError("cannot cache function: no locator available")
        return numba.njit(**options)

    monkeypatch.setattr("cdmisfa.core.arithmetic.compiled.numba", SimpleNamespace(njit=no_folder))

    @compiled
    def double(x: float) -> float:
        return 2.0 * x

    assert needs_compiling(double)
    assert double(1.5) == 3.0
    assert not needs_compiling(double)


def test_what_was_kept_before_a_class_moved_is_made_again(tmp_path: Path) -> None:
    kept = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kept")}
    for home in ("before", "after"):
        (tmp_path / f"{home}.py").write_text(
            "from typing import NamedTuple\nclass Pair(NamedTuple):\n    a: float\n    b: float\n"
        )
        program = tmp_path / "program.py"
        program.write_text(
            f"from {home} import Pair\n"
            "from cdmisfa.core.arithmetic.compiled import compiled\n"
            "@compiled\n"
            "def total(pair):\n"
            "    return pair.a + pair.b\n"
            "print(total(Pair(1.0, 2.0)))\n"
        )
        done = subprocess.run(
            [sys.executable, str(program)], env=kept, capture_output=True, text=True, check=False
        )
        assert (done.stdout, done.stderr) == ("3.0\n", "")
        (tmp_path / f"{home}.py").unlink()
    assert list((tmp_path / "kept").rglob("*.nbi"))


@pytest.mark.parametrize(
    "source",
    [
        b"@compiled\n",
        b"@inlined\n",
        b"@reordered\n",
        b"@in_compiled_code(f)\n",
        b"_f = spliced(f)\n",
    ],
)
def test_a_file_counts_by_each_way_to_compile_alone(source: bytes) -> None:
    assert any(mark in source for mark in MARKS)
