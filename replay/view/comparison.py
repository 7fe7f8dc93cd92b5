"""The curves of several runs over one another, with the table of their outcomes."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from replay.palette import colour
from replay.runs.columns import SignalColumns
from replay.runs.compare import HEAD, ComparedRun
from replay.runs.log import read_columns
from replay.view.build import recording_to
from replay.view.layouts import blueprint, curve_view
from replay.view.summary import text_table
from replay.view.writer import ITERATION, MOST_STREAMS, Writer, drawable, part, power_of_ten

# Signals that are overlaid where a run has them, with the titles of their panels.
CURVES = {
    "eta_dot": "Change of slowness η̇, log10 of [cycles/frame]: a module is saved only below δ",
    "epsilon": "Exploration: probability ε of a random action",
    "eta": "Slowness η [cycles/frame]",
    "reward": "Reward",
    "share": "Share of recent blocks that are novel",
    "tested": "Slowness of the attended stream on new frames [cycles/frame]",
}

# The signal that is overlaid stream by stream.
ERROR = "learning_error"


def build_overlay(
    runs: Sequence[Path],
    compared: Sequence[ComparedRun],
    out: Path,
    *,
    force: bool = False,
) -> None:
    """Write the curves of several runs, one color a run, into one .rrd file.

    The entity `/compare/<number>_<run>/<signal>` holds a run's signal at every iteration.

    Args:
        runs: the runs.
        compared: their rows by `side_by_side`.
        out: the file.
        force: replace an existing file.

    Raises:
        UsageError: `out` exists and `force` is not set.
        LogDamagedError: a run cannot be read.
        CdmisfaError: the file cannot be written.
    """
    names, written = [row.name for row in compared], set[str]()
    roots = [f"compare/{part(names, i)}" for i in range(len(names))]
    with recording_to(out, out.stem, out, force=force) as recording:
        text = drawable("\n".join(text_table(HEAD, (row.cells() for row in compared))))
        table = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
        recording.log("summary", table, static=True)
        for number, (run, row, root) in enumerate(zip(runs, compared, roots, strict=True)):
            header, selected = row.outline.header, row.outline.streams(MOST_STREAMS)
            writer = Writer(recording, header.spec)
            for signals in read_columns(run, header):
                _write_curves(writer, root, signals, selected, number, row.name)
            writer.flush()
            written |= writer.spans.keys()
        recording.send_blueprint(_layout(compared, roots, written))


def _write_curves(
    writer: Writer,
    root: str,
    signals: SignalColumns,
    selected: Sequence[int],
    number: int,
    name: str,
) -> None:
    """Write the curves of a run, and its learning error in the blocks of each stream."""
    for signal in CURVES:
        values = signals[signal].astype(np.float64).reshape(len(signals), -1)
        values = power_of_ten(values) if signal == "eta_dot" else values
        names, rgbs = [name] * values.shape[1], [colour(number)] * values.shape[1]
        writer.lines(f"{root}/{signal}", names, signals.times(), values, rgbs)
    for s in selected:
        watched = np.flatnonzero(signals["stream"] == s)
        if len(watched):
            untested = np.isnan(signals["tested"][watched])
            errors = np.where(untested, np.nan, signals[ERROR][watched])[:, None]
            at = signals.frames[watched], signals.iterations[watched]
            path = f"{root}/{ERROR}/{part(writer.spec.streams, s)}"
            writer.lines(path, [name], at, errors, [colour(number)], gap=signals.tau)


def _layout(
    compared: Sequence[ComparedRun], roots: Sequence[str], written: Collection[str]
) -> rrb.Blueprint:
    """Return a panel for each curve and each stream's error that a run has."""
    outline, length = compared[0].outline, max(row.outline.iterations for row in compared)

    def panels(titles: dict[str, str]) -> list[rrb.View]:
        return [
            curve_view(title, [f"/{root}/{entity}" for root in roots], length)
            for entity, title in titles.items()
            if any(f"{root}/{entity}" in written for root in roots)
        ]

    table = rrb.TextDocumentView(origin="/summary", name="Runs")
    grid = rrb.Grid(*panels(CURVES), grid_columns=2)
    tabs = [rrb.Vertical(table, grid, row_shares=[1, 3], name="Overview")]
    names, shown = outline.names(), outline.streams(MOST_STREAMS)
    errors = {f"{ERROR}/{part(names, s)}": f"Learning error of {drawable(names[s])}" for s in shown}
    if views := panels(errors):
        tabs.append(rrb.Vertical(*views, name="Streams"))
    return blueprint(*tabs, name="Comparison", timeline=ITERATION, length=length)
