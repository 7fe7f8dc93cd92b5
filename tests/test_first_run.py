"""What a first run compiles, by two processes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from cdmisfa.cli.progress import Bar, compiling_said
from cdmisfa.core.arithmetic.compiled import tell_compiling
from cdmisfa.core.arithmetic.first_run import LISTED, compiled_by_two
from cdmisfa.core.arithmetic.kept import described, example_of
from tests.first_run import calls_by_part


class Pair(NamedTuple):
    """Two arguments in one."""

    left: Any
    right: Any


RECORD = np.dtype([("iteration", "<i8"), ("scale", "<f8")])


def readonly(array: Any) -> Any:
    """The same array, not to be written to."""
    array.flags.writeable = False
    return array


@pytest.mark.parametrize(
    "value",
    [
        1,
        2.0,
        True,
        np.float64(1.0),
        np.uint8(1),
        np.zeros(3),
        np.zeros((3, 3, 3), np.uint8),
        np.zeros((3, 2)).T,
        np.zeros((6, 6))[::2, ::3],
        readonly(np.zeros((2, 2))),
        np.zeros(2, ">f8"),
        np.zeros(1, RECORD),
        (1, np.zeros(2)),
        Pair(np.zeros((2, 2)), (1.0, 2)),
    ],
    ids=lambda value: json.dumps(described(value)),
)
def test_a_type_that_is_described_can_be_made_again(value: Any) -> None:
    description = json.loads(json.dumps(described(value)))
    assert described(example_of(description)) == description
    assert type(example_of(description)) is type(value)


@pytest.mark.parametrize("value", [None, "text", 2**70, np.zeros(9, "u1")[1:].view("<i8")])
def test_others_have_no_description(value: Any) -> None:
    if isinstance(value, np.ndarray):  # memory that no array of our own would have
        with pytest.raises(LookupError):
            example_of(described(value))
    else:
        with pytest.raises(LookupError):
            described(value)


def test_listed_is_what_runs_call() -> None:
    listed = json.loads(LISTED.read_text("utf-8"))
    called = {part: {json.dumps(call) for call in calls} for part, calls in listed.items()}
    found = {part: set(calls) for part, calls in calls_by_part().items()}
    assert called == found, "python -m tests.first_run lists them anew"


FIRST_RUN = """
import os, sys
from pathlib import Path
from cdmisfa.agents.exploration import decay
from cdmisfa.core.arithmetic import first_run
from cdmisfa.core.arithmetic.choice import portable_bits
from cdmisfa.core.arithmetic.compiled import told_of_compiling
from cdmisfa.features.slowness import slowness, window_rate

os.sched_getaffinity = lambda process: {0, 1}
first_run.LISTED = Path(sys.argv[1])
told = []
with told_of_compiling(lambda *counts: told.append(counts)):
    with first_run.compiled_by_two({"learning": sys.argv[2] == "portably", "neither": False}):
        print(decay(1.0, .9, .5, .5))
for function, args in ((decay, (1.0,) * 4), (slowness, (1.0, 1.0)), (window_rate, (1, 1))):
    forms = [function.meant]
    with portable_bits():
        forms.append(function.meant)
    print(*(form.on_disk(args) for form in forms), *(len(form.signatures) for form in forms))
print([count for count in told if count[1]])
"""


def first_run(folder: Path, listed: str, how: str = "") -> list[str]:
    """What `FIRST_RUN` prints where nothing is on disk."""
    (folder / "listed.json").write_text(listed)
    words = [sys.executable, "-c", FIRST_RUN, str(folder / "listed.json"), how]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder)}
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert done.stderr == ""
    return done.stdout.splitlines()


NUMBER = "builtins:float"
CALLS = [
    ["cdmisfa.agents.exploration:decay", [NUMBER] * 4],
    ["cdmisfa.features.slowness:slowness", [NUMBER] * 2],
    ["cdmisfa.features.slowness:window_rate", ["builtins:int"] * 2],
]


def test_the_first_function_that_is_not_on_disk_has_all_compiled(tmp_path: Path) -> None:
    value, *functions, told = first_run(tmp_path, json.dumps({"learning": CALLS}))
    assert value == "0.9"
    assert [line.split()[:2] for line in functions] == [["True", "False"]] * 3
    here = [int(line.split()[2]) for line in functions]
    assert here[0] == 1
    assert json.loads(told.replace("(", "[").replace(")", "]"))[-1] == [3, 3]


def test_portable_forms_are_compiled_where_a_part_computes_so(tmp_path: Path) -> None:
    _, *functions, _ = first_run(tmp_path, json.dumps({"learning": CALLS}), "portably")
    assert [line.split()[:2] for line in functions] == [
        ["True", "True"],
        ["False", "True"],
        ["False", "True"],
    ]


MISTAKES = [
    ["cdmisfa.agents.exploration:gone", []],
    ["cdmisfa.gone:decay", []],
    [CALLS[0][0], ["builtins:gone"]],
    [CALLS[0][0], [["Z", 1, "<f8"]]],
    [CALLS[0][0], [["C", 1, "<f8"]] * 4],
    [CALLS[2][0], [NUMBER]],
]


def test_what_is_listed_by_mistake_harms_nothing(tmp_path: Path) -> None:
    value, *functions, _ = first_run(tmp_path, json.dumps({"learning": [*MISTAKES, CALLS[1]]}))
    assert value == "0.9"
    assert [line.split()[0] for line in functions] == ["True", "True", "False"]


@pytest.mark.parametrize("cores", [1, 2])
def test_without_another_process_one_compiles_all(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, cores: int
) -> None:
    tried: list[Any] = []

    def refuse(*arguments: Any) -> None:
        tried.append(arguments)
        raise OSError("Resource temporarily unavailable")

    monkeypatch.setattr("os.sched_getaffinity", lambda process: set(range(cores)))
    monkeypatch.setattr("cdmisfa.core.processes.Workers.submit", refuse)
    monkeypatch.setattr("cdmisfa.core.arithmetic.first_run.LISTED", tmp_path / "listed.json")
    (tmp_path / "listed.json").write_text(json.dumps({"learning": CALLS}))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))

    from cdmisfa.core.arithmetic.compiled import compiled

    with compiled_by_two({"learning": False}):
        assert compiled(halved)(3.0) == 1.5
    assert len(tried) == cores - 1


def halved(x: float) -> float:
    """Half of a number."""
    return x / 2.0


class Noted(Bar):
    """A bar that remembers what it was told."""

    def __init__(self) -> None:
        self.told: list[Any] = []

    def update(self, done: float, total: float | None = None, note: str = "") -> None:
        self.told.append((done, total))

    def turn_to(self, title: str, unit: str) -> None:
        self.told.append(title)

    def say(self, line: str) -> None:
        self.told.append(line.split()[0])


def test_the_wait_has_a_bar_of_its_own() -> None:
    shown = Noted()
    with compiling_said(shown):
        for counts in ((0, 3), (0, 0), (2, 3), (3, 3)):
            tell_compiling(*counts)
    assert shown.told == ["compiling", "compiling", (0, 3), (2, 3), (3, 3), "learning"]
