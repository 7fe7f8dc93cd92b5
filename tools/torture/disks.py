"""Full disks: commands that write to one of a few kilobytes, and go on when it has become larger.

A full disk is one clear error; what is on it is readable; going on gives what was to come.
"""

from __future__ import annotations

import ctypes
import subprocess
from pathlib import Path
from typing import Any

from .commands import Fork, judge
from .kills import begun, check_disk, finish, going_on, nothing_yet
from .outcomes import MIXED, SKIPPED, WRONG, Defect, Job, Limits, Outcome
from .works import WORKS, prepared

LIMITS = Limits(seconds=120, enough=120, share=2)

CLONE_NEWNS = 0x20000
ELSEWHERE = ("icub", "--jobs")
NAMES = tuple(name for name in WORKS if not any(word in name for word in ELSEWHERE))


def prepare(folder: Path) -> dict[str, Any]:
    """Results of commands that have room."""
    return prepared(folder, NAMES)


def case(job: Job) -> Outcome:
    """Fill a disk with what a command writes, then let it go on."""
    name = NAMES[job.seed % len(NAMES)]
    work, disk = WORKS[name], job.folder / "disk"
    disk.mkdir()
    # its mounts end with this process, and nobody else sees them
    if ctypes.CDLL(None).unshare(CLONE_NEWNS) != 0 or not (
        _mount("--make-rprivate", "/") and _mount("-t", "tmpfs", "-o", "size=4k", "disk", disk)
    ):
        return Outcome(SKIPPED, name, "no right to mount a small disk")
    place = disk / "out"
    outcome = Outcome(SKIPPED, name, "it had room")
    for size in sorted(job.rng.choice((4, 8, 16, 40, 80, 160, 320, 640)) for _ in range(2)):
        _mount("-o", f"remount,size={size}k", disk)
        words = work.words(place, job.given["folder"])
        line = going_on(place, words, work) if begun(place) else words
        ran = Fork(job.folder, *line).wait(60, name, f"with {size} kB")
        if nothing_yet(ran):
            ran = Fork(job.folder, *words, "--force").wait(60, name, f"with {size} kB")
        judged = judge(ran, name, limit=None)
        if ran.code == 0:
            break
        outcome = judged
        if "No space left" not in ran.err and "free space" not in ran.err:
            raise Defect(WRONG, name, f"{ran.line}: {size} kB: exit {ran.code}: {ran.told()}")
        check_disk(place, {}, name, ran)
    _mount("-o", "remount,size=100m", disk)
    finish(place, work.words(place, job.given["folder"]), work, name)
    if (found := work.result(place)) != job.given["results"][name]:
        raise Defect(MIXED, name, f"{name}: gone on with, it gives {found}")
    return outcome


def _mount(*words: object) -> bool:
    done = subprocess.run(["mount", *map(str, words)], capture_output=True, check=False)
    return done.returncode == 0
