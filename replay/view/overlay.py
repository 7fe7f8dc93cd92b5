"""The curves of many runs in one view, and the table of what they came to beside them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from cdmisfa.core.errors import UsageError
from cdmisfa.core.signals import SIGNALS, BlockSignals
from replay.palette import colour, packed
from replay.runs.compare import HEAD, Difference, Row
from replay.runs.log import read_signals
from replay.view.build import recording_to
from replay.view.columns import ITERATION, Clock, Column
from replay.view.config import ViewConfig
from replay.view.labels import label, part
from replay.view.layout import blueprint, lines, whole

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
    runs: Sequence[Path],
    rows: Sequence[Row],
    out: Path,
    *,
    force: bool = False,
    config: ViewConfig | None = None,
) -> None:
    """Write the curves of several runs, one colour a run, into one .rrd file.

    The entity `/compare/<number>_<run>/<signal>` holds a run's signal at every iteration.

    Args:
        runs: the runs.
        rows: what `survey` says of them.
        out: the file.
        force: replace an existing file.
        config: how many rows are handed over at once, and how many streams are shown.

    Raises:
        UsageError: `out` exists and `force` is not set.
        LogDamagedError: a run cannot be read.
        CdmisfaError: the file cannot be written.
    """
    if out.exists() and not force:
        raise UsageError(f"{out} exists: choose another name or overwrite with --force")
    config = config or ViewConfig()
    names = [row.name for row in rows]
    with recording_to(out, out.stem, out) as recording:
        text = rr.TextDocument(label(table_text(rows)), media_type=rr.MediaType.MARKDOWN)
        recording.log("summary", text, static=True)
        for i, (run, row) in enumerate(zip(runs, rows, strict=True)):
            _write(recording, run, row, f"compare/{part(names, i)}", i, config)
        recording.send_blueprint(_layout(rows, config))


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


def _write(
    recording: rr.RecordingStream, run: Path, row: Row, root: str, number: int, config: ViewConfig
) -> None:
    spec = row.outline.header.spec
    clock = Clock(spec)
    columns: dict[str, Column] = {}
    shown = row.outline.streams(config.streams)
    for signals in read_signals(run):
        at = np.array([signals.t])
        for entity, values in _curves(signals, spec.streams, shown):
            path = f"{root}/{entity}"
            if path not in columns:
                names = [label(row.name)] * values.size
                colours = [packed(colour(number))] * values.size
                recording.log(path, rr.SeriesLines(names=names, colors=colours), static=True)
                columns[path] = Column(recording, clock, path, config.rows)
            columns[path].add(at, signals.iteration, values.reshape(1, -1))
    for column in columns.values():
        column.flush()


def _curves(
    signals: BlockSignals, names: Sequence[str], shown: Sequence[int]
) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Entity and value of every curve in one iteration."""
    for name in CURVES:
        yield name, np.asarray(getattr(signals, SIGNALS[name].name), dtype=np.float64)
    if signals.R.size:
        for s in shown:
            yield f"{R_STAY}/{part(names, s)}", signals.R[s, 0, s]


def _layout(rows: Sequence[Row], config: ViewConfig) -> rrb.Blueprint:
    axis = whole(max(row.outline.iterations for row in rows))
    outline, names = rows[0].outline, [row.name for row in rows]
    roots = [f"/compare/{part(names, i)}" for i in range(len(names))]

    def panel(title: str, entity: str) -> rrb.View:
        return lines(title, [f"{root}/{entity}" for root in roots], axis)

    streams = outline.names()
    rewards = [
        panel(f"R for staying on {label(streams[s])}", f"{R_STAY}/{part(streams, s)}")
        for s in outline.streams(config.streams)
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
