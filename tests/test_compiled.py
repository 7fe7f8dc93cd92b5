"""Compiled functions, and what is kept of them on disk."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest

from cdmisfa.cli.progress import Bar, compiling_said
from cdmisfa.core.arithmetic.compiled import compiled, told_of_compiling
from cdmisfa.core.arithmetic.kept import MARKS, NUMBA, keep, recalled, runs_alone


def test_without_a_folder_for_results_it_compiles_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    njit = numba.njit

    def no_folder(*functions: object, **options: object) -> object:
        if options.pop("cache", False):
            raise RuntimeError("cannot cache function: no locator available")
        return njit(*functions, **options)

    monkeypatch.setattr(numba, "njit", no_folder)
    monkeypatch.setattr("cdmisfa.core.arithmetic.kept.folder_of", lambda source: None)

    @compiled
    def double(x: float) -> float:
        return 2.0 * x

    told: list[bool] = []
    with told_of_compiling(lambda *_: told.append(True)):
        assert double(1.5) == 3.0
        assert double(2.5) == 5.0
    assert set(told) == {True}
    told.clear()
    with told_of_compiling(lambda *_: told.append(False)):
        assert double(3.5) == 7.0
    assert told == []


def test_compiling_is_told_only_where_nothing_is_on_disk(tmp_path: Path) -> None:
    script = (
        "from cdmisfa.core.arithmetic.compiled import told_of_compiling\n"
        "from cdmisfa.agents.exploration import decay\n"
        "with told_of_compiling(lambda done, of: print('compiling')):\n"
        "    decay(1.0, .9, .5, .5)\n"
        "    decay(1.0, .9, .5, .5)\n"
    )

    def said() -> str:
        here = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
        return subprocess.run(
            [sys.executable, "-c", script], env=here, check=True, capture_output=True, text=True
        ).stdout

    assert set(said().split()) == {"compiling"}
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
        "import numpy as np\n"
        "from cdmisfa.core.arithmetic.compiled import compiled\n"
        "@compiled\n"
        "def least(x):\n"
        "    if len(x) > 3:\n"
        "        raise ValueError('too long', len(x))\n"
        "    return np.min(x)\n"
        "assert least(np.array([2.0, 1.0])) == 1.0\n"
        "print('numba' in sys.modules, 'scipy.linalg' in sys.modules)\n"
        "try:\n"
        "    least(np.zeros(4))\n"
        "except ValueError as error:\n"
        "    assert error.args == ('too long', 4)\n"
        "import numba\n"
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
    assert list((tmp_path / "kept").rglob("*.kept"))


KINDS = """
import sys
from typing import NamedTuple
import numpy as np
from cdmisfa.core.arithmetic.compiled import compiled
class Pair(NamedTuple):
    a: np.ndarray
    b: float
@compiled
def total(x, pair):
    x[0] += 1.0
    return x * pair.b + pair.a.sum()
@compiled
def half(n):
    return n / 2
def same(made, expected):
    return made.dtype == expected.dtype and (made == expected).all()
table = np.arange(12.0).reshape(4, 3)
for x, a in (
    (table[0].copy(), np.ones(2, np.uint8)),
    (table[:, 1], np.array([True, False])),
    (np.arange(4), np.ones(3)),
):
    copy = x.copy()
    made = total(x, Pair(a, 2.0))
    copy[0] += 1.0
    assert same(made, copy * 2.0 + a.sum())
    assert (x == copy).all()
assert [half(3), half(True), half(np.float32(3))] == [1.5, 0.5, 1.5]
sys.stderr.write(str('numba.core' in sys.modules))
"""


def test_arguments_of_each_type_have_code_of_their_own_also_when_it_is_kept(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(KINDS)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kept")}
    words = [sys.executable, str(tmp_path / "program.py")]
    for compiler in ("True", "False"):
        done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
        assert done.stderr == compiler
    damaged = next((tmp_path / "kept").glob("program.*.kept"))
    damaged.write_bytes(damaged.read_bytes()[:-1000])
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert done.stderr == "True"


def test_code_is_not_run_on_what_looks_alike() -> None:
    @compiled
    def last(x: Any) -> Any:
        return x[-1]

    @compiled
    def below(n: int) -> int:
        return n - 1

    assert last(np.arange(3.0)) == 2.0
    with pytest.raises(numba.TypingError):
        last(np.arange(3.0).astype(">f8"))
    assert below(2**63) == 2**63 - 1
    assert below(-1) == -2


THREADS = """
import sys
from threading import Barrier, Thread
import numpy as np
from cdmisfa.core.arithmetic.compiled import compiled
@compiled
def first(x):
    return x[0]
@compiled
def last(x):
    return x[-1]
x = np.arange(3.0)
if sys.argv[1:]:
    first(x)
    sys.exit()
made = []
def work(function):
    together.wait()
    made.append(function(x))
functions = [first, last] * 3
together = Barrier(len(functions))
threads = [Thread(target=work, args=(function,)) for function in functions]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
print(sorted(made))
"""


def test_threads_run_what_is_kept_while_others_compile(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(THREADS)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kept")}
    words = [sys.executable, str(tmp_path / "program.py")]
    subprocess.run([*words, "keep"], env=environment, check=True)
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("[0.0, 0.0, 0.0, 2.0, 2.0, 2.0]\n", "")


def test_what_numba_is_told_it_does_itself(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(
        "from cdmisfa.core.arithmetic.compiled import compiled\n"
        "@compiled\n"
        "def same(x):\n"
        "    return x\n"
        "print(same(1.0))\n"
    )
    for told, kept in (
        ({"NUMBA_DISABLE_JIT": "1"}, set()),
        ({"NUMBA_OPT": "1"}, {".nbi", ".nbc"}),
        ({}, {".nbi", ".nbc", ".kept"}),
    ):
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kept"), **told}
        done = subprocess.run(
            [sys.executable, str(program)],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert (done.stdout, done.stderr) == ("1.0\n", "")
        files = [path for path in (tmp_path / "kept").rglob("*") if path.is_file()]
        assert {path.suffix for path in files} == kept


def test_the_processor_is_named_as_the_compiler_names_it(tmp_path: Path) -> None:
    program = (
        "import sys\n"
        "from cdmisfa.core.arithmetic.compiled import compiled_for\n"
        "said = compiled_for()\n"
        "print('numba' in sys.modules)\n"
        "from numba.core.registry import cpu_target\n"
        "assert said == cpu_target.target_context.codegen().magic_tuple()[1:]\n"
    )
    other = {"NUMBA_CPU_NAME": "x86-64", "NUMBA_CPU_FEATURES": ""}
    for settings, compiler in ((other, "True"), ({}, "True"), ({}, "False")):
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), **settings}
        words = [sys.executable, "-c", program]
        done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
        assert (done.stdout, done.stderr) == (f"{compiler}\n", "")


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


def test_what_cannot_be_kept_is_said_to_be_compiled_each_time(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cdmisfa.core.arithmetic.kept.folder_of", lambda source: None)
    with compiling_said(Bar()):
        numba.njit(lambda x: x + 1)(1)
    said = capsys.readouterr().err
    assert "again each time" in said
    assert "set NUMBA_CACHE_DIR to a folder" in said


def test_another_version_of_the_compiler_keeps_what_it_compiles_itself(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert metadata.version("numba").startswith(NUMBA)  # else: is kept code run as before?
    other = ("3.11", "0.69.0", "0.51.0", "2.4.6")
    monkeypatch.setattr("cdmisfa.core.arithmetic.kept._versions", lambda: other)
    assert not runs_alone.__wrapped__()


FULL = """
import resource, signal
from cdmisfa.agents.reward import expert_reward

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))
print(expert_reward(0.5, 0.5, 1.0))
"""


def test_on_a_full_disk_it_runs_on_with_what_it_compiled(tmp_path: Path) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    words = [sys.executable, "-c", FULL]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert not list(tmp_path.rglob("*.kept"))


def test_what_a_power_cut_left_of_kept_code_is_compiled_anew(tmp_path: Path) -> None:
    source = tmp_path / "source.py"
    source.write_text("a source")
    keep("name", source, list(range(1000)))
    assert recalled("name", source) == list(range(1000))
    (kept,) = tmp_path.rglob("*.kept")
    whole = kept.read_bytes()
    for start, stop in ((0, 8), (40, 80), (len(whole) // 2, len(whole))):
        kept.write_bytes(whole[:start] + bytes(stop - start) + whole[stop:])
        with pytest.raises(LookupError):
            recalled("name", source)
    kept.write_bytes(whole)
    assert recalled("name", source) == list(range(1000))
