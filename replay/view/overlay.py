"""The curves of several runs over one another, with the table of their outcomes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from cdmisfa.core.arrays import FloatArray, IntArray
from replay.palette import colour
from replay.runs.columns import SignalColumns
from replay.runs.compare import HEAD, Row
from replay.runs.log import read_columns
from replay.view.build import recording_to
from replay.view.columns import ITERATION, MOST_STREAMS, Column, Target, power_of_ten
from replay.view.labels import label, part, text_table
from replay.view.layouts import blueprint, lines, time_axis

CURVES = {
    "eta_dot": "Change of slowness η̇, as powers of ten: a module is saved when it is below δ",
    "epsilon": "Exploration ε",
    "eta": "Slowness η [1/frame]",
    "reward": "Reward",
    "share": "Share of novel blocks",
    "tested": "Slowness on new frames, of the stream that is watched [1/frame]",
}
"""Signals that are overlaid where a run has them, with the titles of their panels."""

ERROR = "learning_error"
"""The signal that is overlaid stream by stream."""


def build_overlay(
    runs: Sequence[Path],
    rows: Sequence[Row],
    out: Path,
    *,
    force: bool = False,
    tab: str | None = None,
) -> None:
    """Write the curves of several runs, one colour a run, into one .rrd file.

    The entity `/compare/<number>_<run>/<signal>` holds a run's signal at every iteration.

    Args:
        runs: the runs.
        rows: their rows by `side_by_side`.
        out: the file.
        force: replace an existing file.
        tab: name of the tab that is open; by default the first.

    Raises:
        UsageError: `out` exists and `force` is not set, or there is no such tab.
        LogDamagedError: a run cannot be read.
        CdmisfaError: the file cannot be written.
    """
    roots = [f"compare/{part([row.name for row in rows], i)}" for i in range(len(rows))]
    with recording_to(out, out.stem, out, force=force) as recording:
        text = label("\n".join(text_table(HEAD, (row.cells() for row in rows))))
        table = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
        recording.log("summary", table, static=True)
        for number, (run, row, root) in enumerate(zip(runs, rows, roots, strict=True)):
            header, columns = row.outline.header, dict[str, Column]()
            target, shown = Target(recording, header.spec), row.outline.streams(MOST_STREAMS)
            for signals in read_columns(run, header):
                for entity, kept, values in _curves(signals, header.spec.streams, shown):
                    path, within = f"{root}/{entity}", signals.tau if ERROR in entity else 0
                    if path not in columns:
                        names = [row.name] * values.shape[1]
                        rgbs = [colour(number)] * len(names)
                        columns[path] = target.lines(path, names, rgbs, within=within)
                    columns[path].add(signals.frames[kept], signals.iterations[kept], values)
            for column in columns.values():
                column.flush()
        recording.send_blueprint(_layout(rows, roots, tab))


def _curves(
    signals: SignalColumns, names: Sequence[str], shown: Sequence[int]
) -> Iterator[tuple[str, IntArray, FloatArray]]:
    """Entity of each curve, the records in which it has values, and these."""
    for name in CURVES:
        values = signals[name].astype(np.float64).reshape(len(signals), -1)
        yield name, np.arange(len(signals)), power_of_ten(values) if name == "eta_dot" else values
    for s in shown:
        own = np.flatnonzero(signals["stream"] == s)
        if len(own):
            untested = np.isnan(signals["tested"][own])
            errors = np.where(untested, np.nan, signals[ERROR][own])
            yield f"{ERROR}/{part(names, s)}", own, errors.reshape(len(own), -1)


def _layout(rows: Sequence[Row], roots: Sequence[str], tab: str | None) -> rrb.Blueprint:
    length, outline = max(row.outline.iterations for row in rows), rows[0].outline
    told = frozenset[str]().union(*(row.outline.told for row in rows))

    def panel(title: str, entity: str) -> rrb.View:
        return lines(title, [f"/{root}/{entity}" for root in roots], time_axis(length))

    curves = [panel(title, name) for name, title in CURVES.items() if name in told]
    first = rrb.TextDocumentView(origin="/summary", name="Runs"), rrb.Grid(*curves, grid_columns=2)
    tabs = [rrb.Vertical(*first, row_shares=[1, 3], name="Overview")]
    if ERROR in told:
        names, shown = outline.names(), outline.streams(MOST_STREAMS)
        titles = [f"Learning error of {label(names[s])}" for s in shown]
        places = [f"{ERROR}/{part(names, s)}" for s in shown]
        errors = map(panel, titles, places)
        tabs.append(rrb.Vertical(*errors, name="Streams"))
    return blueprint(*tabs, name="Comparison", timeline=ITERATION, length=length, tab=tab)
