"""The curves of many runs in one view, and the table of what they came to beside them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from replay.palette import colour
from replay.runs.columns import SignalColumns
from replay.runs.compare import HEAD, Difference, Row
from replay.runs.stretches import read_columns
from replay.view.build import recording_to
from replay.view.columns import ITERATION, Column, line_column
from replay.view.labels import label, part
from replay.view.layouts.panels import MOST_STREAMS, blueprint, lines, time_axis

CURVES = {
    "eta_dot": "Change of slowness η̇: a module is saved when it falls below δ",
    "eta": "Slowness η [1/frame]",
    "xi": "Change of weights ξ",
    "reward": "Reward",
    "share": "Share of novel blocks",
    "epsilon": "Exploration ε",
}
"""Signals that are overlaid, with the titles of their panels."""

FIRST_TAB = ("eta_dot", "epsilon")

R_STAY = "R_stay"


def build_overlay(
    runs: Sequence[Path], rows: Sequence[Row], out: Path, *, force: bool = False
) -> None:
    """Write the curves of several runs, one colour a run, into one .rrd file.

    The entity `/compare/<number>_<run>/<signal>` holds a run's signal at every iteration.

    Args:
        runs: the runs.
        rows: what `side_by_side` says of them.
        out: the file.
        force: replace an existing file.

    Raises:
        UsageError: `out` exists and `force` is not set.
        LogDamagedError: a run cannot be read.
        CdmisfaError: the file cannot be written.
    """
    names = [row.name for row in rows]
    with recording_to(out, out.stem, out, force=force) as recording:
        text = rr.TextDocument(label(table_text(rows)), media_type=rr.MediaType.MARKDOWN)
        recording.log("summary", text, static=True)
        for i, (run, row) in enumerate(zip(runs, rows, strict=True)):
            _write(recording, run, row, f"compare/{part(names, i)}", i)
        recording.send_blueprint(_layout(rows))


def table_text(rows: Sequence[Row]) -> str:
    """The rows as a Markdown table."""
    ruler = tuple("---" for _ in HEAD)
    short = [(*row.cells()[:-1], _shortly(row.difference)) for row in rows]
    cells = [[cell.replace("|", "/") for cell in line] for line in (HEAD, ruler, *short)]
    return "\n".join(["## Runs compared", "", *(f"| {' | '.join(line)} |" for line in cells)])


def _shortly(difference: Difference | None) -> str:
    if difference is None:
        return "identical"
    if difference.iteration < 0:
        return f"{difference.first} against {difference.second}, else identical"
    return f"differs from iteration {difference.iteration}, first in {difference.signal}"


def _write(recording: rr.RecordingStream, run: Path, row: Row, root: str, number: int) -> None:
    header = row.outline.header
    shown = row.outline.streams(MOST_STREAMS)
    lines: dict[str, Column] = {}
    for columns in read_columns(run, header):
        for entity, values in _curves(columns, header.spec.streams, shown):
            path, rows = f"{root}/{entity}", values.reshape(len(columns), -1)
            if path not in lines:
                width = rows.shape[1]
                names, rgbs = [row.name] * width, [colour(number)] * width
                lines[path] = line_column(recording, header.spec, path, names, rgbs)
            lines[path].add(*columns.times(), rows)
    for line in lines.values():
        line.flush()


def _curves(
    columns: SignalColumns, names: Sequence[str], shown: Sequence[int]
) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Entity and values of every curve in some iterations."""
    for name in CURVES:
        yield name, columns[name].astype(np.float64)
    if columns["R"].size:
        for s in shown:
            yield f"{R_STAY}/{part(names, s)}", columns["R"][:, s, 0, s]


def _layout(rows: Sequence[Row]) -> rrb.Blueprint:
    axis = time_axis(max(row.outline.iterations for row in rows))
    outline, names = rows[0].outline, [row.name for row in rows]
    roots = [f"/compare/{part(names, i)}" for i in range(len(names))]

    def panel(title: str, entity: str) -> rrb.View:
        return lines(title, [f"{root}/{entity}" for root in roots], axis)

    streams = outline.names()
    rewards = [
        panel(f"R for staying on {label(streams[s])}", f"{R_STAY}/{part(streams, s)}")
        for s in outline.streams(MOST_STREAMS)
    ]
    first = [panel(CURVES[name], name) for name in FIRST_TAB]
    table = rrb.TextDocumentView(origin="/summary", name="Runs")
    return blueprint(
        rrb.Horizontal(table, rrb.Vertical(*first), column_shares=[2, 4], name="Overview"),
        rrb.Vertical(*rewards, name="Rewards"),
        rrb.Grid(*(panel(title, name) for name, title in CURVES.items()), name="All curves"),
        name="Comparison",
        timeline=ITERATION,
    )
