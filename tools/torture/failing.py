"""Let a system call fail in the middle of a command: once, or all from then on.

The command ends with one clear line or with its result; what is on disk is readable, and resuming
gives the same bytes.
"""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Any

from .calls import KINDS, Refusal, refusing
from .cases import RIGHT, SKIPPED, Job
from .commands import here, judge
from .kills import check_disk
from .works import WORKS, not_begun
from .works import prepare as prepare_works

WAYS: dict[str, dict[str, Any]] = {
    "an I/O error": {"code": errno.EIO},
    "a device that is gone": {"code": errno.EIO, "lasting": True},
    "a full disk": {"kinds": ("write", "mkdir"), "code": errno.ENOSPC, "lasting": True},
}
NAMES = tuple(name for name in WORKS if name not in ("record icub", "sweep --jobs 2"))
"""Works that are quick and run in one process."""


def prepare(folder: Path) -> tuple[Path, dict[str, Any], dict[tuple[str, str], int]]:
    """Return the folder that works read, their results, and the calls of each that can fail."""
    results, _ = prepare_works(folder, NAMES)
    calls = {}
    for name in NAMES:
        for way, how in WAYS.items():
            place = folder / "counted" / name / way
            refusal = Refusal(-1, how.get("kinds", KINDS))
            with refusing(place, refusal):
                here(*WORKS[name].words(place, folder))
            calls[name, way] = refusal.seen
    return folder, results, calls


def case(job: Job) -> str:
    """Let a call fail, perhaps another one on resuming, then finish."""
    rng, (shared, results, calls) = job.rng, job.shared
    name = NAMES[job.seed % len(NAMES)]
    work, place, failed = WORKS[name], job.folder / "out", False
    for _ in range(rng.choice((1, 1, 2))):
        way = rng.choice(list(WAYS))
        refusal = Refusal(rng.randrange(calls[name, way]), **WAYS[way])
        with refusing(place, refusal):
            ran = here(*work.again(place, shared))
        if not not_begun(ran):
            judge(ran, limit=None)
        failed = failed or refusal.seen > refusal.number
        check_disk(place, {}, ran)
    work.finish(place, shared, results[name])
    return RIGHT if failed else SKIPPED
