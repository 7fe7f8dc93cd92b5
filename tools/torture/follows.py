"""A recording that is written, and a run that follows it: one of them killed, or both.

Who follows a recording whose writer is no more ends, as its log does. When both have gone on, the
run is that on the recording of a writer that was never killed.
"""

from __future__ import annotations

import signal
import time
from pathlib import Path
from typing import Any

from .commands import LIMIT, Fork, Ran, here, judge, must, until, worst
from .kills import check_disk, nothing_yet
from .outcomes import MIXED, RIGHT, WRONG, Defect, Job, Limits, Outcome
from .witness import due, witnessing
from .works import EASY, files, run

LIMITS = Limits(seconds=120, enough=100, beside=3, share=1)

FRAMES = 1500
TIMEOUT = 2
RECORD = ("record", "oscillatory", "--frames", FRAMES, "--seed", 3)
LEARN = (*EASY, "--max-modules", 9, "--max-iterations", 70, "--no-rerun")
FOLLOW = ("--follow", "--follow-timeout", TIMEOUT)
SIGNALS = {"kill -9": signal.SIGKILL, "TERM": signal.SIGTERM, "INT": signal.SIGINT}


def prepare(folder: Path) -> dict[str, Any]:
    """The recording and the run that nobody kills."""
    must(folder, *RECORD, "-o", folder / "rec")
    ran = here("learn", folder / "rec", *LEARN, *FOLLOW, "-o", folder / "run")
    if ran.code != 0:
        raise Defect(WRONG, "setup", f"{ran.line}: {ran.told()}")
    return {"rec": files(folder / "rec"), "run": run(folder / "run")}


def case(job: Job) -> Outcome:
    """Kill some, let them go on, and compare."""
    rng, rec, place = job.rng, job.folder / "rec", job.folder / "run"
    who = rng.choice(("writer", "follower", "both"))
    how, number = rng.choice(list(SIGNALS.items()))
    group = f"{who}: {how}"
    writer = Fork(job.folder, *RECORD, "-o", rec, tweak=witnessing(job.folder / "written", 0.03))
    until(lambda: any(rec.glob("*.mcap*")), 10)
    words = ("learn", rec, *LEARN, *FOLLOW, "-o", place)
    follower = Fork(job.folder, *words, tweak=witnessing(job.folder / "learned", 0.005))
    until(lambda: not (writer.running or follower.running), rng.uniform(0, 3))
    for process, name in ((writer, "writer"), (follower, "follower")):
        if who in (name, "both"):
            process.send(number)
            killed = time.monotonic()
            ran = process.wait(LIMIT, group, f"after {how}")
            witness = job.folder / ("written" if name == "writer" else "learned")
            at = rec if name == "writer" else place
            check_disk(at, due(witness, killed, 50.0), group, ran)
    outcomes = [_ended(process.wait(TIMEOUT + 20, group), group) for process in (writer, follower)]
    _goes_on((*RECORD, "-o", rec), rec, group, over=writer.code == 0)
    if files(rec) != job.given["rec"]:
        raise Defect(MIXED, group, "the recording is another")
    over = follower.code == 0 and run(place)["ended"] != "log_exhausted"
    _goes_on(words, place, group, over=over)
    if (found := run(place)) != job.given["run"]:
        raise Defect(MIXED, group, f"the run is another: {found}")
    return worst(outcomes)


def _ended(ran: Ran, group: str) -> Outcome:
    return judge(ran, group, limit=None) if ran.code >= 0 else Outcome(RIGHT, group)


def _goes_on(words: tuple[object, ...], place: Path, group: str, *, over: bool) -> None:
    if over:
        return
    begun = place.exists() and any(place.iterdir())
    ran = here(*words, *(("--resume",) if begun else ()))
    if nothing_yet(ran):
        ran = here(*words, "--force")
    if ran.code != 0:
        raise Defect(WRONG, group, f"{ran.line}: after a kill: exit {ran.code}: {ran.told()}")
