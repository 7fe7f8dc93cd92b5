"""The N-th call on the disk fails, for every N: once, or from then on.

An error of a device (EIO) comes once and goes away, or stays; a disk that is full (ENOSPC) takes
no more writes until there is room.
"""

from __future__ import annotations

import errno
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

from .calls import KINDS, Call, Refusal, watched
from .outcomes import CLEAR_ERROR, LOST, RIGHT, SKIPPED, Defect, Job, Limits, Outcome
from .stories import (
    OUT,
    STORIES,
    WITH_WORKERS,
    Story,
    check,
    command,
    compare,
    refuse_unclear,
)

LIMITS = Limits(share=8)


@dataclass(frozen=True, slots=True)
class Way:
    """How calls fail."""

    name: str
    kinds: tuple[str, ...]
    code: int
    lasting: bool


WAYS = (
    Way("an I/O error", KINDS, errno.EIO, lasting=False),
    Way("a device that is gone", KINDS, errno.EIO, lasting=True),
    Way("a full disk", ("write", "mkdir"), errno.ENOSPC, lasting=True),
)


@dataclass(frozen=True, slots=True)
class Begun:
    """A story's folder as it is before its command, and what comes of it.

    Attributes:
        calls: all that the command makes.
    """

    story: Story
    folder: Path
    result: Any
    progress: int
    calls: tuple[Call, ...]

    def cases(self) -> Iterator[tuple[Way, int]]:
        """Every call that can fail, in every way."""
        for way in WAYS:
            for number in range(sum(call.kind in way.kinds for call in self.calls)):
                yield way, number


def begin(story: Story, folder: Path) -> Begun:
    """Do what a story does before, and once all of it."""
    before, once = folder / "before", folder / "once"
    before.mkdir(parents=True)
    story.begin(before)
    shutil.copytree(before, once)
    seen = Refusal(-1)
    with watched(once / OUT, seen):
        ended = command(once, story.words)
    assert ended.code in story.done, str(ended)
    progress = story.progress(before / OUT) if (before / OUT).exists() else 0
    return Begun(story, before, story.result(once / OUT), progress, tuple(seen.seen))


def fail(begun: Begun, way: Way, number: int, folder: Path) -> Outcome:
    """Let one call fail, and check what is left.

    Raises:
        Defect: the rule does not hold.
    """
    story = begun.story
    shutil.copytree(begun.folder, folder, dirs_exist_ok=True)
    refusal = Refusal(number, way.kinds, way.code, way.lasting)
    with watched(folder / OUT, refusal):
        ended = command(folder, story.words)
    if number >= len(refusal.seen):  # a slow run flushes more often, by the clock
        return Outcome(SKIPPED, story.name, "no such call this time")
    call = refusal.seen[number]
    what = f"{way.name} at {call.kind} {number} of {call.path.name}: {ended}"
    refuse_unclear(story, ended)
    if ended.code in story.done:
        compare(story, folder, begun.result, what)
        return Outcome(RIGHT, story.name, what)
    out = folder / OUT
    progress = story.progress(out) if out.exists() else 0
    if progress < begun.progress:
        raise Defect(LOST, story.name, f"{what}: {begun.progress} became {progress}")
    on = check(story, folder, begun.result, what)
    return Outcome(CLEAR_ERROR, story.name, f"{what}; gone on with by {on}")


def prepare(folder: Path) -> list[tuple[Begun, Way, int]]:
    """Every case there is, those of all stories among each other."""
    stories = (*STORIES.values(), *WITH_WORKERS.values())
    begun = [begin(story, folder / str(i)) for i, story in enumerate(stories)]
    found = [(one, way, number) for one in begun for way, number in one.cases()]
    Random(0).shuffle(found)
    return found


def case(job: Job) -> Outcome:
    """The case of a seed; see `Job`."""
    begun, way, number = job.given[job.seed % len(job.given)]
    return fail(begun, way, number, job.folder)
