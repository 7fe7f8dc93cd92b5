"""Running cases: each in a forked process, for a share of the time, with its result in a line."""

from __future__ import annotations

import contextlib
import json
import math
import os
import random
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import Any, TextIO

from .outcomes import GOOD, HANG, MEMORY, WRONG, Defect, Job, Limits, Outcome

CASES = "cases.jsonl"


@dataclass(frozen=True, slots=True)
class Campaign:
    """A campaign while it runs."""

    name: str
    module: ModuleType
    seeds: Iterator[int]
    given: Any
    limits: Limits

    @property
    def enough(self) -> float:
        """Cases after which it ends."""
        most = len(self.given) if isinstance(self.given, list) else math.inf
        return most if self.limits.enough is None else self.limits.enough


@dataclass(frozen=True, slots=True)
class Running:
    """A case while it runs."""

    campaign: Campaign
    seed: int
    pid: int
    pidfd: int
    folder: Path
    began: float


@dataclass(slots=True)
class Results:
    """The lines of all cases in a folder; those of an earlier run are kept and gone on after."""

    path: Path
    lines: list[dict[str, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Read what is there; the end of a line that was cut off is dropped."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        whole = b""
        if self.path.exists():
            raw = self.path.read_bytes()
            whole = raw[: raw.rfind(b"\n") + 1]
        self.path.write_bytes(whole)
        self.lines = [json.loads(line) for line in whole.splitlines()]

    def add(self, line: dict[str, Any]) -> None:
        """Append a line, at once."""
        self.lines.append(line)
        with self.path.open("a") as file:
            file.write(json.dumps(line) + "\n")

    def begin(self, told: dict[str, Any]) -> None:
        """Note a run; what is of another commit than its own is put aside under that one's name."""
        commits = [line["run"]["commit"] for line in self.lines if "run" in line]
        if commits and commits[-1] != told["commit"]:
            self.path.replace(self.path.with_stem(f"{self.path.stem}-{commits[-1]}"))
            self.lines = []
        self.add({"run": told})

    def cases(self, campaign: str) -> int:
        """How many there are of a campaign."""
        return sum(line["count"] for line in self.lines if line.get("campaign") == campaign)

    def seeds(self, campaign: str, first: int) -> Iterator[int]:
        """Those from `first` on of which there is no line yet."""
        done = {line["seed"] for line in self.lines if line.get("campaign") == campaign}
        number = first
        while True:
            if number not in done:
                yield number
            number += 1


def run(
    campaign: Campaign,
    results: Results,
    deadline: float,
    jobs: int,
    say: TextIO,
    *,
    fewest: int = 0,
) -> None:
    """Run cases until there are enough, or the time is over; those that run are ended in peace.

    Args:
        campaign: with what `prepare` gave.
        results: each case is written there as it ends.
        deadline: until when, by the monotonic clock.
        jobs: cases that compute at a time; see `Limits`.
        say: where found defects are told.
        fewest: cases that are run even when the time is over.
    """
    running: dict[int, Running] = {}
    begun, done = 0, results.cases(campaign.name)

    def more() -> bool:
        in_time = begun < fewest or time.monotonic() < deadline
        return in_time and done + len(running) < campaign.enough

    while running or more():
        while len(running) < jobs * campaign.limits.beside and more():
            case = begin(campaign, next(campaign.seeds))
            running[case.pidfd] = case
            begun += 1
        for pidfd in select.select(list(running), [], [], 0.5)[0]:
            line = end(case := running.pop(pidfd))
            results.add(line)
            done += line["count"]
            if "defect" in line:
                print(f"{campaign.name} {case.seed}: {line['defect']}", file=say, flush=True)
        for case in running.values():
            if time.monotonic() - case.began > campaign.limits.seconds:
                os.kill(case.pid, signal.SIGKILL)


def begin(campaign: Campaign, seed: int, folder: Path | None = None) -> Running:
    """Start a case in a process of its own."""
    place = folder or Path(tempfile.mkdtemp(prefix=f"torture-{campaign.name}-"))
    sys.stdout.flush()
    sys.stderr.flush()
    began = time.monotonic()
    pid = os.fork()
    if pid == 0:
        _in_child(campaign, seed, place)
    return Running(campaign, seed, pid, os.pidfd_open(pid), place, began)


def _in_child(campaign: Campaign, seed: int, place: Path) -> None:
    code = 1
    try:
        os.setsid()
        os.chdir(place)
        (place / "case").mkdir()
        rng = random.Random(f"{campaign.name} {seed}")
        outcome = examine(campaign, Job(seed, rng, place / "case", campaign.given))
        (place / "outcome.json").write_text(json.dumps(outcome.as_json()))
        code = 0
    finally:
        os._exit(code)


def examine(campaign: Campaign, job: Job) -> Outcome:
    """One case in this process; an error of the case itself is a defect, too."""
    try:
        outcome: Outcome = campaign.module.case(job)
    except Defect as defect:
        return defect.outcome
    except BaseException as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{Path(last.filename).name}:{last.lineno}"
        return Outcome(WRONG, "the case itself", f"{type(error).__name__} at {where}: {error}")
    return outcome


def end(case: Running, *, keep: bool = False) -> dict[str, Any]:
    """What a case came to that has ended, as its line; what it left is removed."""
    seconds = time.monotonic() - case.began
    # While it is not waited for nobody else has its number, which is that of its session.
    leave = _leftovers(case.pid)
    _, status, usage = os.wait4(case.pid, 0)
    os.close(case.pidfd)
    for pid in leave:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    megabytes = usage.ru_maxrss / 1024
    try:
        outcome = Outcome(**json.loads((case.folder / "outcome.json").read_text()))
    except (OSError, ValueError):
        if os.WIFSIGNALED(status) and seconds >= case.campaign.limits.seconds:
            outcome = Outcome(HANG, "the case itself", f"not at its end after {seconds:.0f} s")
        else:
            outcome = Outcome(WRONG, "the case itself", f"it ended with status {status}")
    limit = case.campaign.limits.megabytes
    if limit is not None and megabytes > limit:
        what = f"{megabytes:.0f} MB, {outcome.kind}: {outcome.detail}"
        outcome = replace(outcome, kind=MEMORY, detail=what)
    if not keep:
        shutil.rmtree(case.folder, ignore_errors=True)
    line = {"campaign": case.campaign.name, "seed": case.seed, **outcome.as_json()}
    if outcome.kind not in GOOD:
        line["defect"] = f"{outcome.kind}: {outcome.group}: {outcome.detail}"
    return {**line, "seconds": round(seconds, 3), "megabytes": round(megabytes)}


def _leftovers(session: int) -> list[int]:
    """Processes of a session but its first; a zombie is none."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != session:
            with contextlib.suppress(OSError, ValueError):
                # pid (name) state parent group session
                state, _, _, of = (entry / "stat").read_text().rpartition(")")[2].split()[:4]
                if int(of) == session and state != "Z":
                    found.append(int(entry.name))
    return found
