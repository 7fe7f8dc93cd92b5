"""The campaigns find what they are to find."""

from __future__ import annotations

import itertools
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from waiting import wait_for

from tools.torture import cases
from tools.torture.calls import Refusal, refusing
from tools.torture.cases import DEFECT, REFUSED, RIGHT, Defect, Job
from tools.torture.commands import ROOT, Ran, judge
from tools.torture.kills import check_disk, due


def ran(case: Any, **limits: Any) -> Counter[str]:
    module = SimpleNamespace(case=case, __name__="made", **limits)
    return cases.run(module, itertools.count(), None, time.monotonic() - 1, 1)


def broken(job: Job) -> str:
    raise KeyError("x")


def found(job: Job) -> str:
    raise Defect("two seconds are lost")


def greedy(job: Job) -> str:
    return RIGHT if b"x" * (600 << 20) else ""


def test_what_must_not_happen_is_a_defect(capsys: pytest.CaptureFixture[str]) -> None:
    assert ran(lambda job: RIGHT) == {RIGHT: 2}
    assert ran(broken) == ran(found) == ran(greedy, MEGABYTES=512) == {DEFECT: 2}
    printed = capsys.readouterr().out
    assert "made --case 1: the case itself: KeyError at " in printed.replace("  ", " ")
    assert "two seconds are lost" in printed


def test_a_case_that_hangs_is_ended_with_all_that_it_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def hanging(job: Job) -> str:
        child = subprocess.Popen(["sleep", "600"])
        (tmp_path / "child").write_text(str(child.pid))
        time.sleep(600)
        return RIGHT

    monkeypatch.setattr(cases, "SECONDS", 0.5)
    assert ran(hanging) == {DEFECT: 2}
    state = Path("/proc", (tmp_path / "child").read_text(), "stat")
    # A killed process dies when it is scheduled next.
    wait_for(lambda: not state.exists() or state.read_text().split()[2] == "Z", 30)


@pytest.mark.parametrize(
    ("code", "err", "seconds", "kind"),
    [
        (0, "", 1.0, RIGHT),
        (2, "cdmisfa: no such file\n", 1.0, REFUSED),
        (1, "Traceback (most recent call last):\n", 1.0, DEFECT),
        (1, "cdmisfa: unexpected KeyError: 1\n", 1.0, DEFECT),
        (1, "", 1.0, DEFECT),
        (-11, "", 1.0, DEFECT),
        (0, "", 6.0, DEFECT),
    ],
)
def test_how_commands_are_judged(code: int, err: str, seconds: float, kind: str) -> None:
    try:
        assert judge(Ran(("info",), code, "", err, seconds)) == kind
    except Defect:
        assert kind == DEFECT


def test_notes_say_what_must_have_been_flushed(tmp_path: Path) -> None:
    notes = [f"run {n} {n / 8}" for n in range(1, 25)] + [f"x1 {64 * n} 3.0" for n in (1, 2, 3)]
    (tmp_path / "notes").write_text("\n".join(notes) + "\n")
    # Killed at 3.0: what came before 2.0 less the time of a block; less 50 frames and a block.
    assert due(tmp_path / "notes", 3.0, 50.0) == {"run": 15, "x1": 192 - 50 - 64}


def test_what_is_missing_or_broken_on_disk_is_a_defect(
    tmp_path: Path, oscillatory_run: Path
) -> None:
    ran = Ran(("learn",), -9, "", "", 1.0)
    check_disk(oscillatory_run, {"run": 15}, ran)
    with pytest.raises(Defect, match="run has 15, had 16"):
        check_disk(oscillatory_run, {"run": 16}, ran)
    data = (oscillatory_run / "run.mcap").read_bytes()
    (tmp_path / "run.mcap").write_bytes(data[: len(data) // 2])
    with pytest.raises(Defect, match=r"run\.mcap is not readable"):
        check_disk(tmp_path, {}, ran)


def test_calls_fail_in_the_folder_alone(tmp_path: Path) -> None:
    refusal = Refusal(2, ("open", "write", "fsync"), 28)
    with refusing(tmp_path / "a", refusal):
        (tmp_path / "b").write_text("x")
        (tmp_path / "a").mkdir()
        (tmp_path / "a" / "c").write_text("x")
        with pytest.raises(OSError, match="No space"):
            (tmp_path / "a" / "d").write_text("x")
    assert refusal.seen == 3
    (tmp_path / "a" / "d").write_text("x")


def test_a_minute_of_all_campaigns_finds_nothing() -> None:
    """Here only the fewest cases of each."""
    line = [sys.executable, "-m", "tools.torture", "--minutes", "0", "--jobs", "1"]
    done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("right") == 3
