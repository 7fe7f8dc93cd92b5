"""Segments of many logs as a page of contact sheets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from replay.report.drawing import data_uri, reduced, sheet
from replay.report.page import rendered
from replay.report.panels import PIXELS

MOST_LOGS = 200
"""Logs that are listed."""


def report_of_segments(
    logs: Sequence[Mapping[str, Any]],
    segments: Sequence[Mapping[str, Any]],
    pictures: Sequence[Sequence[tuple[str, Sequence[Any]]]],
    seconds: Mapping[str, float],
    budget: float,
    known: Path | None,
) -> str:
    """The page of what was chosen.

    Args:
        logs: `log`, `new`, seconds by verdict, and `problem` of each.
        segments: `log`, `t`, `seconds` and `new` of each.
        pictures: of the first segments, by the names of their streams.
        seconds: of all logs, by verdict.
        budget: in seconds.
        known: the run whose modules know what is known.
    """
    chosen = sum(segment["seconds"] for segment in segments)
    by = f", {seconds['known']:,.1f} s are known to {known}" if known is not None else ""
    return rendered(
        {
            "kind": "curated",
            "title": f"{len(segments)} segments of {len(logs)} logs",
            "lead": f"{chosen:,.1f} s of a budget of {budget:,.1f} s. Of all streams together "
            f"{seconds['novel']:,.1f} s are no noise{by}, {seconds['noise']:,.1f} s are noise.",
            "segments": [_segment(*pair) for pair in zip(segments, pictures, strict=False)],
            "more": max(len(segments) - len(pictures), 0),
            "logs": [
                (row["log"], f"{row['new']:.2f}", *(f"{row[n]:,.1f}" for n in seconds),
                 row["problem"] or "")
                for row in logs[:MOST_LOGS]
            ],
            "command": "cdmisfa cut --segments segments.csv -o cut",
            "frames": {},
        }
    )  # fmt: skip


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
