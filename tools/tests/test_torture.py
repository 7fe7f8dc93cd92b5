"""The campaigns find what they are to find, and go on where they were stopped."""

from __future__ import annotations

import io
import json
import subprocess
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from waiting import python, wait_for

from tools.torture import harness, page
from tools.torture.campaigns import CAMPAIGNS, campaign
from tools.torture.commands import Ran, judge
from tools.torture.kills import check_disk
from tools.torture.outcomes import (
    CLEAR_ERROR,
    HANG,
    LOST,
    MEMORY,
    RIGHT,
    SKIPPED,
    TRACEBACK,
    WRONG,
    Defect,
    Job,
    Limits,
    Outcome,
)
from tools.torture.witness import due

NAME = next(iter(CAMPAIGNS))


def made(case: Any, results: harness.Results, **limits: Any) -> harness.Campaign:
    module: Any = SimpleNamespace(case=case)
    return harness.Campaign("made", module, results.seeds("made", 0), None, Limits(**limits))


def ran(case: Any, folder: Path, **limits: Any) -> dict[str, Any]:
    results = harness.Results(folder / "cases.jsonl")
    return harness.end(harness.begin(made(case, results, **limits), 7))


def test_a_case_is_the_same_from_its_seed(tmp_path: Path) -> None:
    def case(job: Job) -> Outcome:
        assert list(job.folder.iterdir()) == []
        return Outcome(RIGHT, "random", str(job.rng.random()))

    first, again = ran(case, tmp_path), ran(case, tmp_path)
    assert first["kind"] == RIGHT
    assert first["detail"] == again["detail"]


def lost(job: Job) -> Outcome:
    raise Defect(LOST, "group", "two seconds")


def broken(job: Job) -> Outcome:
    raise KeyError("x")


def endless(job: Job) -> Outcome:
    while True:
        time.sleep(1)


def greedy(job: Job) -> Outcome:
    return Outcome(RIGHT, "group", str(len(b"x" * (600 << 20))))


@pytest.mark.parametrize(
    ("case", "kind", "limits"),
    [
        (lost, LOST, {}),
        (broken, WRONG, {}),
        (greedy, MEMORY, {"megabytes": 512.0}),
    ],
)
def test_what_must_not_happen_is_a_defect(
    tmp_path: Path, case: Any, kind: str, limits: dict[str, Any]
) -> None:
    line = ran(case, tmp_path, **limits)
    assert line["kind"] == kind
    assert line["defect"].startswith(kind)


def test_a_case_that_hangs_is_ended_with_all_that_it_started(tmp_path: Path) -> None:
    def hanging(job: Job) -> Outcome:
        child = subprocess.Popen(["sleep", "600"])
        (tmp_path / "child").write_text(str(child.pid))
        return endless(job)

    results = harness.Results(tmp_path / "cases.jsonl")
    hung = made(hanging, results, seconds=0.5)
    harness.run(hung, results, time.monotonic() + 0.05, 1, io.StringIO())
    assert [line["kind"] for line in results.lines] == [HANG]
    state = Path("/proc", (tmp_path / "child").read_text(), "stat")
    # a killed process dies when it is scheduled next
    wait_for(lambda: not state.exists() or state.read_text().split()[2] == "Z", 30)


def test_results_are_gone_on_with(tmp_path: Path) -> None:
    path = tmp_path / "cases.jsonl"
    for _ in range(2):
        results = harness.Results(path)
        good = made(lambda job: Outcome(RIGHT, "group"), results)
        harness.run(good, results, time.monotonic() + 1.0, 2, io.StringIO(), fewest=2)
        with path.open("a") as file:
            file.write('{"campaign": "ma')  # cut off
    seeds = [line["seed"] for line in harness.Results(path).lines]
    assert sorted(seeds) == list(range(len(seeds)))
    assert len(seeds) > 2


def test_what_prepares_for_long_has_its_fewest_cases(tmp_path: Path) -> None:
    results = harness.Results(tmp_path / "cases.jsonl")
    good = made(lambda job: Outcome(RIGHT, "group"), results)
    harness.run(good, results, time.monotonic() - 60, 2, io.StringIO(), fewest=3)
    assert sorted(line["seed"] for line in results.lines) == [0, 1, 2]


@pytest.mark.parametrize(("given", "enough"), [(None, 5), (["of", "all", "five", "done", 1], None)])
def test_a_campaign_ends_when_there_are_enough(tmp_path: Path, given: Any, enough: Any) -> None:
    """Also when it is gone on with."""
    results = harness.Results(tmp_path / "cases.jsonl")
    for deadline in (-60.0, 60.0):  # the first time the fewest alone
        good = made(lambda job: Outcome(RIGHT, "group"), results, enough=enough)
        good = replace(good, given=given)
        harness.run(good, results, time.monotonic() + deadline, 2, io.StringIO(), fewest=3)
    assert sorted(line["seed"] for line in results.lines) == [0, 1, 2, 3, 4]


def test_results_are_of_one_commit(tmp_path: Path) -> None:
    path = tmp_path / "cases.jsonl"
    case = {"campaign": "made", "seed": 0}
    for commit in ("abc", "abc", "def"):
        results = harness.Results(path)
        results.begin({"commit": commit})
        results.add(case)
    assert harness.Results(path).lines == [{"run": {"commit": "def"}}, case]
    assert (
        harness.Results(tmp_path / "cases-abc.jsonl").lines
        == [{"run": {"commit": "abc"}}, case] * 2
    )
    assert next(harness.Results(path).seeds("made", 0)) == 1


@pytest.mark.parametrize(
    ("code", "err", "seconds", "kind"),
    [
        (0, "", 1.0, RIGHT),
        (2, "cdmisfa: no such file\n", 1.0, CLEAR_ERROR),
        (1, "Traceback (most recent call last):\n", 1.0, TRACEBACK),
        (1, "cdmisfa: unexpected KeyError: 1\n", 1.0, TRACEBACK),
        (1, "", 1.0, TRACEBACK),
        (-11, "", 1.0, TRACEBACK),
        (0, "", 6.0, HANG),
    ],
)
def test_how_commands_are_judged(code: int, err: str, seconds: float, kind: str) -> None:
    try:
        found = judge(Ran(("info",), code, "", err, seconds), "group")
    except Defect as defect:
        found = defect.outcome
    assert found.kind == kind


def test_the_page_counts_what_was_found() -> None:
    shared, where = {"seconds": 36.0, "megabytes": 90}, "in /x/torture-x-1/case/out"
    lines = [
        {"run": {"commit": "abc", "python": "3.11", "platform": "here", "seed": 0}},
        *({"campaign": NAME, "seed": n, **Outcome(RIGHT, "a", count=3).as_json(), **shared}
          for n in range(4)),
        {"campaign": NAME, "seed": 8, **Outcome(SKIPPED, "a").as_json(), **shared},
        {"campaign": NAME, "seed": 9, **Outcome(LOST, "b", where).as_json(), **shared,
         "defect": "lost: much"},
    ]  # fmt: skip
    found = page.summary(lines)
    text = page.markdown(json.loads(json.dumps(found)), "found.json")
    assert found["campaigns"][0]["groups"] == [
        {"group": "a", RIGHT: 12, SKIPPED: 1},
        {"group": "b", LOST: 1},
    ]
    assert "at commit abc: 13 cases in 0.1 hours of work, of the first seed 0;" in text
    assert f"| 13 | 12 | {CAMPAIGNS[NAME]} |" in text
    assert f"lost, {NAME}, b: in out (" in text
    assert f"python -m tools.torture {NAME} --case 9" in text


def test_a_witness_tells_what_must_have_been_flushed(tmp_path: Path) -> None:
    notes = [f"run {n} {n / 8}" for n in range(1, 25)] + [f"x1 {64 * n} 3.0" for n in (1, 2, 3)]
    (tmp_path / "witness").write_text("\n".join(notes) + "\n")
    # killed at 3.0, what came before 2.0 less the time of a block; less 50 frames and a block
    assert due(tmp_path / "witness", 3.0, 50.0) == {"run": 15, "x1": 192 - 50 - 64}
    assert due(tmp_path / "nothing", 3.0, 50.0) == {}


def test_what_is_missing_or_broken_on_disk_is_a_defect(
    tmp_path: Path, oscillatory_run: Path
) -> None:
    ran = Ran(("learn",), -9, "", "", 1.0)
    check_disk(oscillatory_run, {"run": 15}, "group", ran)
    with pytest.raises(Defect, match="run has 15, had 16") as found:
        check_disk(oscillatory_run, {"run": 16}, "group", ran)
    assert found.value.outcome.kind == LOST
    data = (oscillatory_run / "run.mcap").read_bytes()
    (tmp_path / "run.mcap").write_bytes(data[: len(data) // 2])
    with pytest.raises(Defect, match=r"run\.mcap is not readable") as found:
        check_disk(tmp_path, {}, "group", ran)
    assert found.value.outcome.kind == WRONG


@pytest.mark.parametrize("name", CAMPAIGNS)
def test_every_campaign_is_what_the_harness_takes(name: str) -> None:
    module = campaign(name)
    assert module.__doc__
    assert callable(module.case)


@pytest.mark.parametrize("name", CAMPAIGNS)
def test_every_campaign_ends(name: str) -> None:
    """By a number of its own, or with its list."""
    module = campaign(name)
    assert module.LIMITS.enough or module.prepare.__annotations__["return"].startswith("list")


def test_an_unknown_campaign_is_refused() -> None:
    done = python("-m", "tools.torture", "kittens", cwd=Path(__file__).parents[2])
    assert done.returncode == 2
    assert "no campaign kittens" in done.stderr
