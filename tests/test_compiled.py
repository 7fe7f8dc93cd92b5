"""Compiled functions, and what is kept of them on disk."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numba
import pytest

from cdmisfa.cli.progress import Bar, compiling_said
from cdmisfa.core.arithmetic.compiled import before_compiling, compiled
from cdmisfa.core.arithmetic.kept import MARKS


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

    told: list[bool] = []
    with before_compiling(lambda: told.append(True)):
        assert double(1.5) == 3.0
        assert double(2.5) == 5.0
    assert told == [True]
    with before_compiling(lambda: told.append(False)):
        assert double(3.5) == 7.0
    assert told == [True]


def test_compiling_is_told_only_where_nothing_is_on_disk(tmp_path: Path) -> None:
    script = (
        "from cdmisfa.core.arithmetic.compiled import before_compiling\n"
        "from cdmisfa.agents.exploration import decay\n"
        "with before_compiling(lambda: print('compiling')):\n"
        "    decay(1.0, .9, .5, .5)\n"
        "    decay(1.0, .9, .5, .5)\n"
    )

    def said() -> str:
        here = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
        return subprocess.run(
            [sys.executable, "-c", script], env=here, check=True, capture_output=True, text=True
        ).stdout

    assert said() == "compiling\n"
    assert said() == ""


def test_what_only_compiled_code_calls_is_not_readied_for_python() -> None:
    @compiled
    def double(x: float) -> float:
        return 2.0 * x

    @compiled
    def quadruple(x: float) -> float:
        return double(double(x))

    assert quadruple(1.5) == 6.0
    assert double.signatures == []  # type: ignore[attr-defined]
    assert double(1.5) == 3.0


def test_what_is_kept_is_loaded_without_the_compiler(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(
        "import sys\n"
        "import numba\n"
        "import numpy as np\n"
        "from cdmisfa.core.arithmetic.compiled import compiled\n"
        "@compiled\n"
        "def least(x):\n"
        "    if len(x) > 3:\n"
        "        raise ValueError('too long', len(x))\n"
        "    return np.min(x)\n"
        "assert least(np.array([2.0, 1.0])) == 1.0\n"
        "try:\n"
        "    least(np.zeros(4))\n"
        "except ValueError as error:\n"
        "    assert error.args == ('too long', 4)\n"
        "print('numba.np.arraymath' in sys.modules, 'scipy.linalg' in sys.modules)\n"
        "assert numba.njit(lambda x: np.min(x) + 1.0)(np.array([2.0, 1.0])) == 2.0\n"
    )
    kept = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kept")}
    for imported in ("True", "False"):
        done = subprocess.run(
            [sys.executable, str(program)], env=kept, capture_output=True, text=True, check=False
        )
        assert (done.stdout.split()[:1], done.stderr) == ([imported], "")
    assert done.stdout == "False False\n"


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


def test_the_wait_for_compiling_is_said_without_a_terminal(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with compiling_said(Bar()):
        numba.njit(lambda x: x + 1)(1)
    assert capsys.readouterr().err.startswith("compiling for this machine")
