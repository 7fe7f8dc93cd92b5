"""The curves of many runs in one view, and the table of what they came to beside them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path, PurePath

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from cdmisfa.core.arrays import FloatArray, IntArray
from replay.palette import Rgb, colour
from replay.runs.columns import SignalColumns
from replay.runs.compare import Difference, Row
from replay.runs.log import read_columns
from replay.view.build import recording_to
from replay.view.columns import ITERATION, MOST_STREAMS, Column, Target, power_of_ten
from replay.view.labels import label, part, text_table
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

FORKED = "forked"
"""Entities of the points from which on forks go their own way."""

FIRST = 3
"""Streams of the first tab."""

MOST_KEYS = 4
"""Keys that runs were told otherwise and that have a column."""

Curve = tuple[str, IntArray, FloatArray]
"""Entity of a curve, which records it has values in, and these."""


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
    """What runs were told otherwise, by name, and what came of it, as a Markdown table.

    A sentence above says which of them are identical to the first one.
    """
    keys = list(dict.fromkeys(key for row in rows for key, *_ in row.told))[:MOST_KEYS]
    of_first = {key: first for row in rows for key, first, _ in row.told}
    cells = []
    for row in rows:
        told = of_first | {key: own for key, _, own in row.told}
        name, _, iterations, learned, _ = row.cells()
        compared = _shortly(row.difference) if row is not rows[0] else "-"
        said = (name, *(str(told[key]) for key in keys), learned, iterations, compared)
        cells.append([cell.replace("|", "/") for cell in said])
    same = [row.name for row in rows[1:] if row.difference is None]
    lines = [f"Identical to {rows[0].name}, bit for bit: {', '.join(same)}."] if same else []
    if len(same) == len(rows) - 1 > 1:
        lines = [f"All {len(rows)} runs are identical, bit for bit."]
    lines += [f"What they were told otherwise: {', '.join(keys)}."] if keys else []
    forks = [line for row in rows if (line := _fork(row))]
    head = "run", *keys, "modules", "iterations", "against the first run"
    return "\n\n".join([*lines, "\n".join(text_table(head, cells)), *forks])


def _fork(row: Row) -> str:
    """The parent of a fork and its changes, in words; "" of another run."""
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
    header, rgb = row.outline.header, colour(number)
    target = Target(recording, header.spec)
    shown = row.outline.streams(MOST_STREAMS)
    lines: dict[str, Column] = {}
    fork, marked = header.forked_at, set[str]()
    for columns in read_columns(run, header):
        for entity, kept, found in _curves(columns, header.spec.streams, shown):
            path, values = f"{root}/{entity}", found.reshape(len(kept), -1)
            frames, iterations = columns.frames[kept], columns.iterations[kept]
            if path not in lines:
                names, rgbs = [row.name] * values.shape[1], [rgb] * values.shape[1]
                within = columns.tau if entity.startswith(OF_STREAM) else 0
                lines[path] = target.lines(path, names, rgbs, within=within)
            lines[path].add(frames, iterations, values)
            if fork is not None and entity not in marked and iterations[-1] >= fork:
                marked.add(entity)
                first = int(np.searchsorted(iterations, fork))
                place, name = f"{root}/{FORKED}/{entity}", f"fork {row.name}"
                _mark(recording, place, name, rgb, int(iterations[first]), values[first])
    for line in lines.values():
        line.flush()


def _mark(
    recording: rr.RecordingStream,
    path: str,
    name: str,
    rgb: Rgb,
    iteration: int,
    values: FloatArray,
) -> None:
    """A point on each of an entity's curves."""
    count = len(values)
    style = rr.SeriesPoints(
        names=[label(name)] * count,
        colors=[rgb] * count,
        markers=["diamond"] * count,
        marker_sizes=[5.0] * count,
    )
    recording.log(path, style, static=True)
    recording.set_time(ITERATION, sequence=iteration)
    recording.log(path, rr.Scalars(values))
    recording.reset_time()


def _curves(columns: SignalColumns, names: Sequence[str], shown: Sequence[int]) -> Iterator[Curve]:
    """Every curve in some iterations."""
    every = np.arange(len(columns))
    for name in CURVES:
        values = columns[name].astype(np.float64)
        yield _entity(name), every, power_of_ten(values) if name in POWERS else values
    for s in shown:
        if columns["R"].size:
            yield f"{R_STAY}/{part(names, s)}", every, columns["R"][:, s, 0, s]
        own = np.flatnonzero(columns["stream"] == s)
        if len(own):
            untested = np.isnan(columns["tested"][own])
            error = np.where(untested, np.nan, columns["learning_error"][own])
            yield f"{OF_STREAM}/{part(names, s)}", own, error


def _entity(name: str) -> str:
    """Entity of a signal's curve, below its run's."""
    return f"log_{name}" if name in POWERS else name


def _layout(rows: Sequence[Row], tab: str | None) -> rrb.Blueprint:
    length = max(row.outline.iterations for row in rows)
    axis, outline, names = time_axis(length), rows[0].outline, [row.name for row in rows]
    told = frozenset[str]().union(*(row.outline.told for row in rows))
    roots = [f"/compare/{part(names, i)}" for i in range(len(names))]
    forks = [row.outline.header.forked_at is not None for row in rows]
    roots += [f"{root}/{FORKED}" for root, fork in zip(roots, forks, strict=True) if fork]

    def panel(title: str, entity: str) -> rrb.View:
        return lines(title, [f"{root}/{entity}" for root in roots], axis)

    def by_stream(title: str, entity: str, most: int = MOST_STREAMS) -> list[rrb.View]:
        streams = outline.names()
        return [
            panel(f"{title} {label(streams[s])}", f"{entity}/{part(streams, s)}")
            for s in outline.streams(most)
        ]

    def curves(names: Iterable[str]) -> list[rrb.View]:
        return [panel(CURVES[name], _entity(name)) for name in names if name in told]

    first = curves(FIRST_TAB) if "eta_dot" in told else by_stream(ERROR_OF, OF_STREAM, FIRST)
    table = rrb.TextDocumentView(origin="/summary", name="Runs")
    tabs: list[rrb.Container] = [
        rrb.Vertical(table, rrb.Horizontal(*first), row_shares=[2, 3], name="Overview")
    ]
    if "R" in told:
        tabs.append(rrb.Vertical(*by_stream("R for staying on", R_STAY), name="Rewards"))
    if "learning_error" in told:
        tabs.append(rrb.Vertical(*by_stream(ERROR_OF, OF_STREAM), name="Streams"))
    tabs.append(rrb.Grid(*curves(CURVES), grid_columns=2, name="All curves"))
    return blueprint(*tabs, name="Comparison", timeline=ITERATION, length=length, tab=tab)
