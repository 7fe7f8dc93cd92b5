"""The curves of many runs in one view, and the table of what they came to beside them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path, PurePath

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from replay.palette import Rgb, colour
from replay.runs.columns import SignalColumns
from replay.runs.compare import HEAD, Difference, Row
from replay.runs.log import read_columns
from replay.view.build import recording_to
from replay.view.columns import ITERATION, MOST_STREAMS, Column, line_column, power_of_ten
from replay.view.labels import label, part
from replay.view.layouts import blueprint, lines, time_axis

CURVES = {
    "eta_dot": "Change of slowness η̇, as powers of ten: a module is saved when it is below δ",
    "eta": "Slowness η [1/frame]",
    "xi": "Change of weights ξ, as powers of ten",
    "reward": "Reward",
    "share": "Share of novel blocks",
    "learning_error": "Learning error of the stream that is watched",
    "tested": "Slowness on new frames, of the stream that is watched [1/frame]",
    "epsilon": "Exploration ε",
}
"""Signals that are overlaid where a run tells them, with the titles of their panels."""

POWERS = ("eta_dot", "xi")
"""Those that are drawn as powers of ten, at `log_<signal>`: they fall through several."""

FIRST_TAB = ("eta_dot", "epsilon")
"""Those of the first tab; of the progress learner the errors of its streams stand there."""

R_STAY = "R_stay"

OF_STREAM, ERROR_OF = "learning_error_of", "Learning error of"

Point = tuple[int, NDArray[np.float64]]
"""An iteration, and the values of a curve there."""

FORKED = "forked"
"""Entities of the points where forks begin."""

MARKER = 5.0
"""Size of such a point."""

FIRST = 3
"""Streams of the first tab."""


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
        rows: what `side_by_side` says of them.
        out: the file.
        force: replace an existing file.
        tab: name of the tab that is open; by default the first.

    Raises:
        UsageError: `out` exists and `force` is not set, or there is no such tab.
        LogDamagedError: a run cannot be read.
        CdmisfaError: the file cannot be written.
    """
    names = [row.name for row in rows]
    with recording_to(out, out.stem, out, force=force) as recording:
        text = rr.TextDocument(label(table_text(rows)), media_type=rr.MediaType.MARKDOWN)
        recording.log("summary", text, static=True)
        for i, (run, row) in enumerate(zip(runs, rows, strict=True)):
            _write(recording, run, row, f"compare/{part(names, i)}", i)
        recording.send_blueprint(_layout(rows, tab))


def table_text(rows: Sequence[Row]) -> str:
    """The rows as a Markdown table."""
    ruler = tuple("---" for _ in HEAD)
    short = [(*row.cells()[:-1], _shortly(row.difference)) for row in rows]
    cells = [[cell.replace("|", "/") for cell in line] for line in (HEAD, ruler, *short)]
    forks = [line for row in rows if (line := _fork(row))]
    table = [f"| {' | '.join(line)} |" for line in cells]
    return "\n".join(["## Runs compared", "", *table, *(("", *forks) if forks else ())])


def _fork(row: Row) -> str:
    """What a fork is one of; "" of another run."""
    header = row.outline.header
    ancestry = header.manifest.get("fork")
    if header.forked_at is None or not isinstance(ancestry, Mapping):
        return ""
    changed = ancestry.get("changed")
    told = changed.items() if isinstance(changed, Mapping) else ()
    what = "".join(f"; {key} {old} became {new}" for key, (old, new) in told)
    parent, at = PurePath(str(ancestry.get("parent"))).name, header.forked_at
    return f"{row.name} is a fork of {parent} after {at} iterations{what}"


def _shortly(difference: Difference | None) -> str:
    if difference is None:
        return "identical"
    if difference.iteration < 0:
        return f"{difference.first} against {difference.second}, else identical"
    if not difference.signal:
        return f"identical as far as both go, {difference.iteration} iterations"
    return f"differs from iteration {difference.iteration}, first in {difference.signal}"


def _write(recording: rr.RecordingStream, run: Path, row: Row, root: str, number: int) -> None:
    header = row.outline.header
    shown = row.outline.streams(MOST_STREAMS)
    lines: dict[str, Column] = {}
    fork, marked, last = row.outline.header.forked_at, set[str](), dict[str, Point]()
    for columns in read_columns(run, header):
        for entity, kept, values in _curves(columns, header.spec.streams, shown):
            path, rows = f"{root}/{entity}", values.reshape(int(kept.sum()), -1)
            if fork is not None and entity not in marked and len(rows):
                at = columns.iterations[kept]
                first = int(np.searchsorted(at, fork))
                if first < len(at):
                    before = (int(at[first - 1]), rows[first - 1]) if first else last.get(entity)
                    there = _between(before, (int(at[first]), rows[first]), fork)
                    place, color = f"{root}/{FORKED}/{entity}", colour(number)
                    _mark(recording, place, row.name, color, *there)
                    marked.add(entity)
                last[entity] = int(at[-1]), rows[-1]
            if path not in lines:
                width = rows.shape[1]
                names, rgbs = [row.name] * width, [colour(number)] * width
                lines[path] = line_column(recording, header.spec, path, names, rgbs)
            lines[path].add(columns.frames[kept], columns.iterations[kept], rows)
    for line in lines.values():
        line.flush()


def _between(before: Point | None, after: Point, iteration: int) -> Point:
    """The point of a curve at an iteration, or the next one that there is."""
    if before is None or iteration == after[0] or np.isnan(before[1]).any():
        return after
    share = (iteration - before[0]) / (after[0] - before[0])
    return iteration, before[1] + share * (after[1] - before[1])


def _mark(
    recording: rr.RecordingStream,
    path: str,
    run: str,
    rgb: Rgb,
    iteration: int,
    values: NDArray[np.float64],
) -> None:
    """A point on a curve where a fork begins to differ from its parent."""
    style = rr.SeriesPoints(
        names=[label(f"fork {run}")] * len(values),
        colors=[rgb] * len(values),
        markers=["diamond"] * len(values),
        marker_sizes=[MARKER] * len(values),
    )
    recording.log(path, style, static=True)
    recording.set_time(ITERATION, sequence=iteration)
    recording.log(path, rr.Scalars(values))
    recording.reset_time()


def _curves(
    columns: SignalColumns, names: Sequence[str], shown: Sequence[int]
) -> Iterator[tuple[str, NDArray[np.bool_], NDArray[np.float64]]]:
    """Entity of every curve in some iterations, in which of them it has values, and these."""
    every = np.ones(len(columns), dtype=bool)
    for name in CURVES:
        values = columns[name].astype(np.float64)
        yield _entity(name), every, power_of_ten(values) if name in POWERS else values
    for s in shown:
        if columns["R"].size:
            yield f"{R_STAY}/{part(names, s)}", every, columns["R"][:, s, 0, s]
        own = columns["stream"] == s
        if own.any():
            untested = np.isnan(columns["tested"][own])
            error = np.where(untested, np.nan, columns["learning_error"][own])
            yield f"{OF_STREAM}/{part(names, s)}", own, error


def _entity(name: str) -> str:
    """Where a signal's curve is, below its run."""
    return f"log_{name}" if name in POWERS else name


def _layout(rows: Sequence[Row], tab: str | None) -> rrb.Blueprint:
    axis = time_axis(max(row.outline.iterations for row in rows))
    outline, names = rows[0].outline, [row.name for row in rows]
    roots = [f"/compare/{part(names, i)}" for i in range(len(names))]

    def panel(title: str, entity: str) -> rrb.View:
        marks = [
            f"{root}/{FORKED}/{entity}"
            for root, row in zip(roots, rows, strict=True)
            if row.outline.header.forked_at is not None
        ]
        return lines(title, [*(f"{root}/{entity}" for root in roots), *marks], axis)

    told = frozenset[str]().union(*(row.outline.told for row in rows))
    streams = outline.names()

    def by_stream(title: str, entity: str, most: int = MOST_STREAMS) -> list[rrb.View]:
        shown = [(label(streams[s]), part(streams, s)) for s in outline.streams(most)]
        return [panel(f"{title} {stream}", f"{entity}/{place}") for stream, place in shown]

    def curves(names: Iterable[str]) -> list[rrb.View]:
        return [panel(CURVES[name], _entity(name)) for name in names if name in told]

    first = curves(FIRST_TAB) if "eta_dot" in told else by_stream(ERROR_OF, OF_STREAM, FIRST)
    rewards = by_stream("R for staying on", R_STAY) if "R" in told else []
    errors = by_stream(ERROR_OF, OF_STREAM) if "learning_error" in told else []
    tabs = [
        *([rrb.Vertical(*rewards, name="Rewards")] if rewards else []),
        *([rrb.Vertical(*errors, name="Streams")] if errors else []),
    ]
    table = rrb.TextDocumentView(origin="/summary", name="Runs")
    return blueprint(
        rrb.Horizontal(table, rrb.Vertical(*first), column_shares=[2, 4], name="Overview"),
        *tabs,
        rrb.Grid(*curves(CURVES), grid_columns=2, name="All curves"),
        name="Comparison",
        timeline=ITERATION,
        length=max(row.outline.iterations for row in rows),
        tab=tab,
    )
