"""Several runs beside one another: whether and how they differ, curves and attention."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from replay.report.drawing import WIDE, Axis, Plot, colour_class, padded
from replay.report.panels import TALL, timeline
from replay.report.told import read_told
from replay.report.trust import command
from replay.runs.compare import Row, side_by_side

CURVES = {
    "learning_error": "Learning error e of the stream that is watched (logarithmic)",
    "eta_dot": "How much the slowness of the first output still changes, |η̇| (logarithmic)",
    "tested": "Slowness on new frames, of the stream that is watched (logarithmic)",
    "share": "Share of recent blocks that are new and of the same stream",
    "epsilon": "How often it explores, ε",
}
"""Signals whose curves are laid over one another, with their titles."""

LOGS = ("learning_error", "eta_dot", "tested")
"""Those that are drawn on a logarithmic axis."""

FEW = 4
"""Runs that are named in a command."""

SHOWN = 24
"""Runs that have a timeline of their own."""


def runs_content(
    paths: Sequence[Path],
    title: str,
) -> dict[str, Any]:
    """What the page of several runs is made of; see runs.html."""
    rows = side_by_side(paths)
    outcomes = {_outcome(row) for row in rows}
    same = sum(row.difference is None for row in rows)
    return {
        "kind": "runs",
        "title": title,
        "lead": _lead(rows, len(outcomes), same),
        "rows": [(place, colour_class(place), *row.cells()) for place, row in enumerate(rows)],
        "explained": [line for row in rows for line in row.explanation().splitlines()],
        "curves": [
            (text, plot)
            for name, text in CURVES.items()
            if (plot := _overlay(rows, name, text)) is not None
        ],
        "timelines": [
            _timeline(path, row.name) for path, row in zip(paths[:SHOWN], rows[:SHOWN], strict=True)
        ],
        "more": max(len(paths) - SHOWN, 0),
        "compare": command("compare", *paths) if 1 < len(paths) <= FEW else "",
        "frames": {},
    }


def _outcome(row: Row) -> tuple[int, ...]:
    return tuple(save.stream for save in row.outline.saved)


def _lead(rows: Sequence[Row], outcomes: int, same: int) -> str:
    n = len(rows)
    if same == n and n > 1:
        return f"All {n} runs are identical, bit for bit."
    what = f"came to {outcomes} different outcomes"
    if outcomes == 1:
        what = "learned the same streams in the same order"
        if not rows[0].outline.saved:
            what = "learned nothing"
    as_first = f"; {same} are identical, bit for bit" if same > 1 else ""
    return f"{n} runs: they {what}{as_first}."


def _overlay(rows: Sequence[Row], name: str, text: str) -> Plot | None:
    told = [(k, row.outline) for k, row in enumerate(rows) if name in row.outline.told]
    if not told:
        return None
    curves = []
    for k, outline in told:
        values = outline.lines[name].reshape(outline.iterations, -1)[:, 0]
        values = np.abs(values) if name == "eta_dot" else values
        if not len(values) or np.nanmin(values) == np.nanmax(values):
            continue
        if name == "learning_error":
            values = np.where(np.isfinite(outline.lines["tested"]), values, np.nan)
        curves.append((k, outline.blocks.iterations.astype(float), values))
    if not curves:
        return None
    log = name in LOGS
    low, high = padded(np.concatenate([v for *_, v in curves]), log=log)
    longest = max(float(t[-1]) + 1 for _, t, _ in curves)
    plot = Plot(Axis(0, longest, WIDE), Axis(low, high, TALL, log, turned=True), text)
    plot.grid(5)
    for k, t, values in curves:
        plot.line(colour_class(k), t, values)
    return plot


def _timeline(path: Path, name: str) -> tuple[str, Plot | None, str]:
    told = read_told(path, frames=1)
    return name, timeline(told, "") if len(told) else None, command("report", path)
