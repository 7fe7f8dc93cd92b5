"""Small files that would take gigabytes: each command ends below 512 MB, and says so."""

from __future__ import annotations

import itertools
import multiprocessing
from collections.abc import Callable
from pathlib import Path

from bombs import CAMERAS, write_all

from .commands import here, judge
from .outcomes import Job, Limits, Outcome

LIMITS = Limits(seconds=60, megabytes=512, share=1)

RATE = ("--rate", 25, "--size", "16x12")
LEARN = (*RATE, "--max-iterations", 3, "--set", "learner.tau=10", "--no-rerun")
COMMANDS: dict[str, Callable[[Path, Path], tuple[object, ...]]] = {
    "info": lambda bomb, out: ("info", bomb),
    "verify": lambda bomb, out: ("verify", bomb),
    "learn": lambda bomb, out: ("learn", bomb, *LEARN),
    "convert": lambda bomb, out: ("convert", bomb, *RATE, "-o", out),
    "view": lambda bomb, out: ("view", bomb, "--save", out.with_suffix(".rrd")),
    "export": lambda bomb, out: ("export", bomb, "--to", "images", "-o", out),
}


def prepare(folder: Path) -> list[tuple[str, str, Path]]:
    """Every bomb with every command; written by a process of its own, which takes memory."""
    writing = multiprocessing.get_context("fork").Process(target=write_all, args=(folder,))
    writing.start()
    writing.join()
    places = [Path((folder / f"{number}.path").read_text()) for number in range(len(CAMERAS))]
    return [
        (kind, command, place)
        for (kind, place), command in itertools.product(zip(CAMERAS, places, strict=True), COMMANDS)
    ]


def case(job: Job) -> Outcome:
    """The case of a seed; see `Job`."""
    kind, command, bomb = job.given[job.seed % len(job.given)]
    return judge(here(*COMMANDS[command](bomb, job.folder / "out")), kind)
