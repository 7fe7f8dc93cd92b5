"""Commands with standard streams closed, as a daemon's are, or on a full device.

Each command with every combination: the same exit code, the same files, no traceback.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

from replay.storage.identity import file_sha256

from .commands import Process, Ran, call, judge
from .materials import camera_log, recording, run
from .outcomes import RIGHT, WRONG, Defect, Job, Limits, Outcome

Words = tuple[object, ...]

QUICK = ("--max-iterations", 3, "--set", "learner.tau=10", "--no-rerun")
COMMANDS: dict[str, Callable[[Path, Path], Words]] = {
    "record": lambda at, out: ("record", "oscillatory", "--frames", 100, "-o", out),
    "record --jobs 2": lambda at, out: (
        *("record", "oscillatory", "--frames", 300, "--jobs", 2, "-o", out),
    ),
    "learn": lambda at, out: ("learn", at / "recording", *QUICK, "-o", out),
    "info": lambda at, out: ("info", at / "recording"),
    "info, nothing there": lambda at, out: ("info", at / "nothing"),
    "verify": lambda at, out: ("verify", at / "run"),
    "recover": lambda at, out: ("recover", at / "recording" / "x1.mcap", "-o", out / "x1.mcap"),
    "convert": lambda at, out: (
        *("convert", at / "camera log" / "a.mcap", "--topic", "/cam_left"),
        *("--topic", "/cam_right", "--size", "16x12", "-o", out),
    ),
    "compare": lambda at, out: ("compare", at / "run", at / "run", "--json"),
    "export": lambda at, out: ("export", at / "run", "-o", out / "run.csv"),
    "view": lambda at, out: ("view", at / "run", "--save", out / "run.rrd"),
    "sweep": lambda at, out: (
        *("sweep", "oscillatory", "--seeds", "0:2", "--max-iterations", 3, "-o", out),
    ),
    "sweep --jobs 2": lambda at, out: (
        *("sweep", "oscillatory", "--seeds", "0:2", "--max-iterations", 3, "--jobs", 2, "-o", out),
    ),
    "signals": lambda at, out: ("signals",),
    "doctor": lambda at, out: ("doctor",),
    "reproduce": lambda at, out: ("reproduce", "five", "--trials", 1, "-o", out),
}
CLOSED = tuple(
    " ".join(some)
    for count in (1, 2, 3)
    for some in itertools.combinations(("<&-", ">&-", "2>&-"), count)
)
STREAMS = (*CLOSED, ">/dev/full", "2>/dev/full")
CASES = tuple(itertools.product(STREAMS, COMMANDS))
LIMITS = Limits(seconds=180, enough=len(CASES), share=3)
SAME_BYTES = (".mcap", ".npz", ".csv", ".png")


def prepare(folder: Path) -> dict[str, Any]:
    """What commands read, and what they come to with their streams open."""
    for make, name in ((recording, "recording"), (run, "run"), (camera_log, "camera log")):
        make(folder / name)
    opened = {}
    for name, words in COMMANDS.items():
        place = folder / "open" / name
        ran = call(folder, *words(folder, place))
        opened[name] = ran.code, ran.out + ran.err != "", _files(place)
    return {"folder": folder, "open": opened}


def case(job: Job) -> Outcome:
    """A command with other streams."""
    streams, name = CASES[job.seed % len(CASES)]
    group, place = f"{name}", job.folder / "closed"
    code, speaks, files = job.given["open"][name]
    words = COMMANDS[name](job.given["folder"], place)
    ran = Process(job.folder, *words, shell=streams).wait(110, group, streams)
    judged = _judged(ran, streams, group)
    full = "full" in streams and ran.code == 1 and speaks
    if ran.code != code and not full:
        what = f"{ran.line} {streams}: exit {ran.code}, not {code}: {ran.told()}"
        raise Defect(WRONG, group, what)
    if not full and (found := _files(place)) != files:
        raise Defect(WRONG, group, f"{ran.line} {streams}: other files: {sorted(found)}")
    return judged


def _judged(ran: Ran, streams: str, group: str) -> Outcome:
    """What cannot be told is not missed."""
    if "2>" in streams or (ran.code in (1, 3, 4) and ">" in streams):
        return Outcome(RIGHT, group)
    return judge(ran, group, limit=None)


def _files(place: Path) -> dict[str, str]:
    return {
        str(path.relative_to(place)): file_sha256(path) if path.suffix in SAME_BYTES else ""
        for path in sorted(place.rglob("*"))
        if path.is_file() and path.name != "run.mcap"  # which names its folder
    }
