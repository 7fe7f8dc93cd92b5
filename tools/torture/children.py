"""Worker processes killed, and commands killed that have some, from the moment that these begin.

Without its worker a command goes on or ends within 5 s with a clear line; what is on disk is
readable, and going on gives what was to come. Workers end within 5 s after a killed command.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import psutil

from .commands import LIMIT, Fork, Process, here, judge, until
from .kills import check_disk, finish
from .outcomes import HANG, MIXED, RIGHT, SKIPPED, WRONG, Defect, Job, Limits, Outcome
from .processes import descendants, wait_gone
from .works import WORKS, Work, files

LIMITS = Limits(seconds=200, share=6, enough=300, beside=2)

REAL = 0.2
"""Share of commands that are begun as a user would; workers import everything anyway."""
WORKER = 0.8
"""Share of cases in which a worker is killed; in the others it is the command."""
ALONE = ("--jobs", 1)
"""Going on without workers gives the same, sooner: most cases do."""
BEGINNING = 3.0
"""Seconds after which all workers compute."""
GOING_ON = 90.0
"""Seconds in which what goes on without a worker must have ended."""

PR_SET_CHILD_SUBREAPER = 36


CHILDREN: Mapping[str, Work] = {
    "record icub --jobs 2": Work(
        lambda place, shared: ("record", "icub", "--frames", 150, "--jobs", 2, "-o", place),
        *(("--resume",), files, 5),
    ),
    "record oscillatory --jobs 2": Work(
        lambda place, shared: (
            *("record", "oscillatory", "--frames", 8000, "--jobs", 2),
            *("-o", place),
        ),
        *(("--resume",), files, 3),
    ),
    "sweep --jobs 2": WORKS["sweep --jobs 2"],
}


def prepare(folder: Path) -> dict[str, Any]:
    """Results of commands without workers, and how long each takes."""
    results, seconds = {}, {}
    for name, work in CHILDREN.items():
        place, began = folder / "done" / name, time.monotonic()
        ran = here(*work.words(place, folder), *ALONE)
        if ran.code != 0:
            raise Defect(WRONG, "setup", f"{ran.line}: exit {ran.code}: {ran.told()}")
        results[name], seconds[name] = work.result(place), time.monotonic() - began
    return {"folder": folder, "results": results, "seconds": seconds}


def case(job: Job) -> Outcome:
    """Kill a worker, or their command."""
    rng, given = job.rng, job.given
    names = list(given["results"])
    (name,) = rng.choices(names, [CHILDREN[name].share for name in names])
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1)  # orphans become children of this process
    work, place = CHILDREN[name], job.folder / "out"
    words = work.words(place, given["folder"])
    process = (Process if rng.random() < REAL else Fork)(job.folder, *words)
    until(lambda: bool(workers(process.pid)) or not process.running, 60)
    # half of them at once: while workers begin and import
    takes = rng.choice((0.3, 2.0, BEGINNING + given["seconds"][name]))
    until(lambda: not process.running, rng.uniform(0, takes))
    if rng.random() < WORKER:
        group = f"{name}: its worker"
        outcome = _worker_killed(process, rng.choice((1, 1, 2)), work, group, rng.random())
    else:
        group = f"{name}: itself"
        outcome = _itself_killed(process, group)
    check_disk(place, {}, group, process.ran())
    finish(place, (*words, *rng.choice(((), ALONE, ALONE, ALONE))), work, group)
    if (found := work.result(place)) != given["results"][name]:
        raise Defect(MIXED, group, f"{name}: gone on with, it gives {found}")
    return outcome


def workers(pid: int) -> list[psutil.Process]:
    """Those of a command that compute; what only tidies up after them is none."""
    found = []
    for child in descendants(pid):
        with contextlib.suppress(psutil.NoSuchProcess):
            if "spawn_main" in " ".join(child.cmdline()):
                found.append(child)
    return found


def _worker_killed(process: Process, count: int, work: Work, group: str, which: float) -> Outcome:
    there = workers(process.pid)
    if not there:
        process.wait(GOING_ON, group)
        return Outcome(SKIPPED, group, "it had no worker any more")
    at = int(which * len(there))
    for child in (there[at:] + there[:at])[:count]:
        with contextlib.suppress(psutil.NoSuchProcess):
            child.kill()
    # what is computed in trials is given to another worker
    limit = LIMIT if work.again else GOING_ON
    ran = process.wait(limit, group, "whose worker was killed")
    return judge(ran, group, limit=None)


def _itself_killed(process: Process, group: str) -> Outcome:
    over = not process.running
    process.send(signal.SIGKILL)
    ran = process.wait(LIMIT, group)
    began = time.monotonic()
    until(lambda: not wait_gone(descendants(os.getpid()), 0), LIMIT)
    if left := wait_gone(descendants(os.getpid()), 0):
        seconds = time.monotonic() - began
        raise Defect(HANG, group, f"{ran.line}: {seconds:.0f} s after kill -9 there is {left}")
    return Outcome(SKIPPED if over else RIGHT, group)
