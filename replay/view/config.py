"""What the view of a run can be told (keys `view.*`)."""

from __future__ import annotations

from dataclasses import dataclass

from cdmisfa.core.config import positive


@dataclass(frozen=True, slots=True)
class ViewConfig:
    """How a run is shown.

    Attributes:
        every: show every this many frames of what was watched, of those that were kept.
        streams: streams with lines and lanes of their own: the most watched ones.
        rows: rows of a column that are handed over at once.
    """

    every: int = 10
    streams: int = 16
    rows: int = 4000

    def __post_init__(self) -> None:
        positive(self, "view", "every", "streams", "rows")
