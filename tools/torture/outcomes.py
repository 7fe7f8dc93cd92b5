"""What a case is given, and what it comes to."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from random import Random
from typing import Any

RIGHT = "right"
CLEAR_ERROR = "clear error"
SKIPPED = "skipped"
HELD = (RIGHT, CLEAR_ERROR)
GOOD = (*HELD, SKIPPED)

HANG = "hang"
MIXED = "mixed"
LOST = "lost"
TRACEBACK = "traceback"
MEMORY = "memory"
WRONG = "wrong"
DEFECTS = (HANG, MIXED, LOST, TRACEBACK, MEMORY, WRONG)
"""A command that was to end did not within 5 s; results of other bytes than those that they name;
more lost than the last second; an error that is no clear line; memory over the limit; others."""


@dataclass(frozen=True, slots=True)
class Job:
    """One case.

    Attributes:
        seed: its number; the same one is the same case.
        rng: everything random comes from here.
        folder: empty, its own.
        given: what `prepare` gave.
    """

    seed: int
    rng: Random
    folder: Path
    given: Any


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a case came to.

    Attributes:
        kind: one of `GOOD` or `DEFECTS`.
        group: which row of the page it belongs to.
        detail: what happened, in a line.
        count: how many such cases it stands for.
    """

    kind: str
    group: str
    detail: str = ""
    count: int = 1

    def as_json(self) -> dict[str, Any]:
        """As it stands in a line of the results."""
        return asdict(self)


class Defect(Exception):  # noqa: N818 - it is what was found
    """What must not happen.

    Args:
        kind: one of `DEFECTS`.
        group: as in `Outcome`.
        detail: what was seen, with the command.
    """

    def __init__(self, kind: str, group: str, detail: str) -> None:
        super().__init__(detail)
        self.outcome = Outcome(kind, group, detail)


@dataclass(frozen=True, slots=True)
class Limits:
    """Of the cases of a campaign.

    Attributes:
        seconds: a case that takes longer hangs, whatever it is doing.
        megabytes: most memory of one process of a case; None where inputs are not hostile.
        share: of the time of all campaigns, where that is limited.
        enough: cases after which the campaign ends; what goes through a list ends with that.
        beside: cases at a time for each job; more than one where most of a case is waiting.
    """

    seconds: float = 120.0
    megabytes: float | None = None
    share: float = 1.0
    enough: int | None = None
    beside: int = 1
