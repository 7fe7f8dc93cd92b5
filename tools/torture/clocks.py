"""The clock on the wall jumps all the time, by seconds, days and decades, either way (clock.c).

Recordings, runs and sweeps are what they are without; of live streams, times go on as they do on
the steady clock; nobody waits for a time that the clock has left.
"""

from __future__ import annotations

import itertools
import subprocess
from pathlib import Path
from typing import Any

from recorder.mcap.reader import LogReader

from . import follows
from .commands import Process, here
from .outcomes import MIXED, RIGHT, WRONG, Defect, Job, Limits, Outcome
from .works import WORKS, Work, files, prepared, run

LIMITS = Limits(seconds=120, enough=64, beside=3, share=2)

SOURCE = Path(__file__).with_name("clock.c")
RATE = 30
SECOND = 1_000_000_000


def times(place: Path) -> bool:
    """Of a live stream: whether its times are those of a steady clock."""
    with LogReader(place / "lavfi_testsrc.mcap") as reader:
        stamps = [
            message.log_time
            for message in reader.messages()
            if message.channel.topic[1:5] == "view"
        ]
    steps = [b - a for a, b in itertools.pairwise(stamps)]
    return len(stamps) == RATE and all(0 < step < SECOND for step in steps)


def shown(place: Path) -> bool:
    """Of what shows: whether it wrote a view."""
    return place.with_suffix(".rrd").exists()


LIVE = f"av:lavfi:testsrc=size=32x24:rate={RATE}"
UNLIKE: dict[str, Work] = {
    "record, live": Work(
        lambda place, shared: ("record", LIVE, "--frames", RATE, "--size", "16x12", "-o", place),
        *((), times, 1),
    ),
    "view": Work(
        lambda place, shared: ("view", shared / "run", "--save", place.with_suffix(".rrd")),
        *((), shown, 1),
    ),
}
NAMES = tuple(name for name in WORKS if "icub" not in name and name != "reproduce")
FOLLOWED = "record, and learn --follow"
KINDS = (*NAMES, *UNLIKE, FOLLOWED)


def prepare(folder: Path) -> dict[str, Any]:
    """What commands give by a clock that goes on, and the one that jumps."""
    clock = folder / "clock.so"
    words = ("cc", "-shared", "-fPIC", "-O1", "-Wall", "-Werror", SOURCE, "-o", clock)
    subprocess.run(words, check=True)
    given = prepared(folder, NAMES)
    for name, work in UNLIKE.items():
        place = folder / name
        ran = here(*work.words(place, folder))
        if ran.code != 0:
            raise Defect(WRONG, "setup", f"{ran.line}: {ran.told()}")
        given["results"][name] = work.result(place)
    followed = folder / "followed"
    followed.mkdir()
    return {**given, "clock": clock, FOLLOWED: follows.prepare(followed)}


def case(job: Job) -> Outcome:
    """One command, or one that records and one that follows."""
    name = KINDS[job.seed % len(KINDS)]
    jumping = {"LD_PRELOAD": str(job.given["clock"]), "CLOCK_SEED": str(job.seed)}
    place = job.folder / "out"
    if name == FOLLOWED:
        recording = (*follows.RECORD, "-o", job.folder / "rec")
        learning = ("learn", job.folder / "rec", *follows.LEARN, *follows.FOLLOW, "-o", place)
        lines = [recording, learning]
    else:
        work = {**WORKS, **UNLIKE}[name]
        lines = [work.words(place, job.given["folder"])]
    for process in [Process(job.folder, *line, more=jumping) for line in lines]:
        ran = process.wait(60, name, "by a clock that jumps")
        if ran.code != 0:
            raise Defect(WRONG, name, f"{ran.line}: exit {ran.code}: {ran.told()}")
    if name == FOLLOWED:
        found, wanted = {"rec": files(job.folder / "rec"), "run": run(place)}, job.given[name]
    else:
        found, wanted = work.result(place), job.given["results"][name]
    if found != wanted:
        raise Defect(MIXED, name, f"{name}: by a clock that jumps it gives {found}")
    return Outcome(RIGHT, name)
