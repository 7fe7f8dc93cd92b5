"""Segments of many logs as a page of contact sheets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cdmisfa.core.names import counted
from replay.report.drawing import data_uri, reduced, sheet
from replay.report.page import rendered
from replay.report.panels import PIXELS

MOST_LOGS = 200
"""Logs that are listed."""


@dataclass(frozen=True, slots=True)
class Curated:
    """What `replay.corpus.curate` chose.

    Attributes:
        logs: a row a log, what is new in it first.
        segments: a row a segment, in the order in which they were chosen.
        seconds: of all blocks by their verdict, streams together.
        chosen: seconds of the segments.
        left: why no more were chosen, where the budget is longer; else empty.
        to_cut: how many of the segments `cut` takes.
    """

    logs: list[dict[str, Any]]
    segments: list[dict[str, Any]]
    seconds: dict[str, float]
    chosen: float
    left: str
    to_cut: int

    def as_json(self) -> dict[str, Any]:
        """What the command prints, and curated.json has."""
        kept = ("log", "start", "stop", "seconds", "new")
        segments = [{name: segment[name] for name in kept} for segment in self.segments]
        return {"logs": self.logs, "seconds": self.seconds, "segments": segments}


def report_of_segments(
    found: Curated,
    pictures: Sequence[Sequence[tuple[str, Sequence[Any]]]],
    budget: float,
    known: Path | None,
) -> str:
    """The page of what was chosen.

    Args:
        found: the logs and segments.
        pictures: of the first segments, by the names of their streams.
        budget: in seconds.
        known: the run whose modules know what is known.
    """
    logs, segments, seconds = found.logs, found.segments, found.seconds
    why = f": {found.left}" if found.left else ""
    by = f", {seconds['known']:,.1f} s are known to {known}" if known is not None else ""
    return rendered(
        {
            "kind": "curated",
            "title": f"{counted(len(segments), 'segment')} of {counted(len(logs), 'log')}",
            "lead": f"{found.chosen:,.1f} s of a budget of {budget:,.1f} s{why}. Of all streams "
            f"together {seconds['novel']:,.1f} s are no noise{by}, {seconds['noise']:,.1f} s are "
            "noise.",
            "segments": [_segment(*pair) for pair in zip(segments, pictures, strict=False)],
            "more": max(len(segments) - len(pictures), 0),
            "logs": [(*told(row), row["problem"] or "") for row in logs[:MOST_LOGS]],
            "command": "cdmisfa cut --segments segments.csv -o cut" if found.to_cut else "",
            "frames": {},
        }
    )


def told(log: Mapping[str, Any]) -> list[str]:
    """A log's name, how new it is, and its seconds by verdict; dashes, where it was not judged."""
    seconds = [log[name] for name in ("known", "novel", "noise")]
    if log["problem"] and not any(seconds):
        return [log["log"], *"----"]
    return [log["log"], f"{log['new']:.2f}", *(f"{value:,.1f}" for value in seconds)]


def _segment(
    segment: Mapping[str, Any], pictures: Sequence[tuple[str, Sequence[Any]]]
) -> dict[str, Any]:
    start, stop = segment["t"]
    strips = []
    for name, shown in pictures:
        small = [reduced(picture, PIXELS) for picture in shown]
        strips.append((name, data_uri(sheet(small, len(small), 2), photo=True) if small else ""))
    return {
        "log": segment["log"],
        "text": f"Frames {start:,} to {stop - 1:,}, {segment['seconds']:.1f} s, new by "
        f"{segment['new']:.2f}.",
        "strips": strips,
    }
