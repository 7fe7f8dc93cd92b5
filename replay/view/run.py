"""A run as rows of a Rerun recording: every signal as it is, and curves and lanes for people.

`/signals/<name>` holds each signal's values for every iteration, those of run.mcap; a signal that
the run never has gets no entity. Where frames were not watched, or not of a line's stream, lines
have a row of NaN.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray, IntArray
from cdmisfa.core.signals import SIGNALS
from replay.palette import GREY, Colour, colour, faint, packed_all, pale
from replay.runs.columns import Blocks, SignalColumns, has_values
from replay.runs.log import Batch, RunHeader
from replay.runs.run import Outline, rules_of
from replay.view.columns import TIMELINE_SIGNALS, Column, Target, power_of_ten
from replay.view.labels import label, line_labels, part
from replay.view.lanes import Lanes
from replay.view.modules import hang_weights, saved_mark, write_weights
from replay.view.summary import decision_text

AXES = {"S": "stream", "A": "action", "J": "output"}
"""Names of tensors' dimensions; the second S of a tensor is the next stream."""

BESIDE = {"expert": 1, "reward": 2, "gate_mean": 1, "gate_sd": 2, "roc_error": 1}
"""Number of the first colour of signals that are drawn beside another one."""

POWERS = {"eta_dot": "abstraction/log_eta_dot", "xi": "abstraction/log_xi"}
"""Entities of signals drawn as powers of ten: they fall through several."""

OF_STREAM = ("learning_error", "tested", "fitted", "change")
"""Signals of the watched stream: each has its line, of powers of ten, through its own blocks."""

RULES = "rules"
"""Parent entity of how far each rule to save a module is met, as powers of ten: above 0."""

HARDLY_WATCHED = 1000.0
"""Interest from which on a stream promises most because it was hardly watched: it has no line."""

RECENT = 50
"""Blocks over which the share of each stream is taken."""

SPARSE = 10
"""Iterations between two tables of R and Q, and between two tensors of very many streams."""

MOST_IN_TABLE = 6
"""Streams of these tables."""

PHI = "abstraction/phi"
WATCHED_NAME = "world/watched/name"
DECISION_TABLE = "decision/table"


@dataclass(frozen=True, slots=True)
class Curve:
    """Values of an entity that is drawn as lines.

    Attributes:
        path: the entity.
        labels: of the lines.
        values: (n, ...) for the n rows.
        rgbs: colours of the lines; by default pale ones from `number` on.
        rows: which records the values are of; by default all.
        every_frame: there is a row for each frame of a record.
        leads_on: it does not end where nothing was watched.
    """

    path: str
    labels: Sequence[str]
    values: NDArray[Any]
    rgbs: Sequence[Colour] = ()
    number: int = 0
    width: float = 1.5
    rows: NDArray[Any] | None = None
    every_frame: bool = False
    leads_on: bool = False


class RunView:
    """Writes a run into a recording.

    Args:
        recording: the recording.
        header: of the run's log.
        streams: those that get lines and lanes of their own.
        every: show images of every this many frames.
        piece: see `Lanes`.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        header: RunHeader,
        streams: Sequence[int],
        every: int,
        *,
        piece: int | None = None,
    ) -> None:
        self._target, self._spec = Target(recording, header.spec), header.spec
        self._every, self._tau = every, 0
        self._streams, self._by_progress = list(streams), header.by_progress
        self._rules, self._thresholds = rules_of(header), list(lines_of(header))
        self._columns: dict[str, Column] = {}
        self._blocks = Blocks.concatenated(())
        self._recent = np.zeros((0, len(streams)), dtype=bool)
        self._stream_of: dict[int, int] = {}
        self._named = -1
        self._phi: dict[int, FloatArray] = {}
        self._of_now = -1
        self._lanes = Lanes(self._target, streams, by_progress=header.by_progress, piece=piece)

    def take(self, batch: Batch) -> None:
        """Take what a log holds of some iterations."""
        self._blocks = batch.blocks
        for columns in batch.signals:
            self._add(columns)
        for frames, watched in batch.watched:
            self._watched(frames, watched)
        for frames, truth in batch.truth if self._spec.truth else ():
            curve = Curve("world/truth", self._spec.truth, truth, every_frame=True)
            self._draw(curve, frames, batch.blocks.iteration(frames))
        self._weights(batch)
        for event in batch.events:
            self.event(event.t, event.iteration, event.text, event.level)

    def finish(self, outline: Outline) -> None:
        """Write thresholds and the end of lanes, and hand over what waits."""
        starts, iterations = outline.blocks.starts, outline.blocks.iterations
        if outline.iterations:
            self.threshold(starts[[0, -1]], iterations[[0, -1]])
            self._lanes.end(outline.end, int(iterations[-1]))
        self.flush()

    def _add(self, columns: SignalColumns) -> None:
        """Take the records of consecutive iterations."""
        self._tau = columns.tau
        saved = np.flatnonzero(columns["saved"])
        modules, streams = columns["module"][saved].tolist(), columns["stream"][saved].tolist()
        self._stream_of |= zip(modules, streams, strict=True)
        curves = [self._signals, self._powers, self._decision, self._gate, self._attention]
        for made in [*curves, self._of_streams if self._by_progress else self._met]:
            for curve in made(columns):
                rows = slice(None) if curve.rows is None else curve.rows
                self._draw(curve, *(times[rows] for times in columns.times(curve.every_frame)))
        self._tensors(columns)
        self._table(columns)
        self._name(columns)
        if len(saved):
            self._saved(columns, saved)
        self._lanes.add(columns)

    def _draw(self, curve: Curve, frames: IntArray, iterations: IntArray) -> None:
        rgbs: list[Colour] = list(curve.rgbs)
        if not rgbs:
            one = len(set(curve.labels)) == 1
            rgbs = [pale(curve.number + (0 if one else i)) for i in range(len(curve.labels))]
        how = curve.labels, rgbs, curve.width
        within = 0 if curve.leads_on else 1 if curve.every_frame else self._tau
        line = self._column(curve.path, self._target.lines, *how, within=within)
        line.add(frames, iterations, curve.values.reshape(len(frames), -1))

    def _watched(self, at: IntArray, frames: NDArray[Any]) -> None:
        """Take (n, *frame_shape) of what the learner saw at n frames."""
        if self._spec.images:
            kept = at % self._every == 0
            if not kept.all():
                at, frames = at[kept], frames[kept]
        if len(at):
            column = self._column("world/watched", self._target.frames, 1.5)
            column.add(at, self._blocks.iteration(at), frames)

    def _weights(self, batch: Batch) -> None:
        """Show the weights of what learns from the watched stream, as far as the log has them.

        Of the progress learner each stream has its candidate, and the log the weights of the one
        that comes next. They are shown once its stream is; until then those that the watched one
        had last, or none (white).
        """
        kept = dict(batch.phi)
        for columns in batch.signals:
            now = columns["stream"]
            then = np.where(columns["saved"], now, columns["next_stream"])
            rows = (columns.frames, columns.iterations, now, then if self._by_progress else now)
            for t, iteration, s, owner in zip(*(row.tolist() for row in rows), strict=True):
                phi, shown = kept.get(t), None
                if self._by_progress and s != self._of_now and self._phi:
                    shown = self._phi.get(s, 0 * next(iter(self._phi.values())))
                self._of_now = s
                if phi is not None:
                    if not self._phi:
                        hang_weights(self._target, PHI, len(phi))
                    self._phi[owner] = phi
                    shown = phi if owner == s else shown
                if shown is not None:
                    write_weights(self._target, PHI, t, iteration, shown)

    def event(self, t: int, iteration: int, text: str, level: str = "INFO") -> None:
        """Say in words what happened."""
        level = "WARN" if level == "WARNING" else level
        self._target.log_at("events", t, iteration, rr.TextLog(label(text), level=level))

    def threshold(self, frames: IntArray, iterations: IntArray) -> None:
        """Draw the lines below which something is learned, through frames, (n,)."""
        for path, name, value in self._thresholds:
            curve = Curve(path, [name], np.full(len(frames), value), [GREY], leads_on=True)
            self._draw(curve, frames, iterations)

    def flush(self) -> None:
        """Hand over everything that waits."""
        for column in self._columns.values():
            column.flush()
        self._lanes.flush()

    def _signals(self, columns: SignalColumns) -> Iterator[Curve]:
        """Every signal's values as they are, but for tensors."""
        outputs = columns["y"].shape[2]
        for signal in SIGNALS.values():
            value, path = columns[signal.name], f"signals/{signal.name}"
            if signal.name in TIMELINE_SIGNALS or signal.show == "heat":
                continue
            if value.dtype.kind == "i" and not has_values(signal.name, value):
                continue
            every_frame = "T" in signal.dims
            if signal.dims == "S":
                rgbs: list[Colour] = [colour(s) for s in range(len(self._spec.streams))]
                yield Curve(path, self._spec.streams, value, rgbs)
            elif signal.dims.startswith("M"):
                for i in range(value.shape[1]):
                    labels = line_labels(signal, i + 1, outputs)
                    rgbs, place = self._of_module(i + 1, labels), f"{path}/{i + 1}"
                    yield Curve(place, labels, value[:, i], rgbs, every_frame=every_frame)
            else:
                labels, number = line_labels(signal, 0, outputs), BESIDE.get(signal.name, 0)
                yield Curve(path, labels, value, number=number, every_frame=every_frame)

    def _of_module(self, module: int, labels: Sequence[str]) -> list[Colour]:
        """The colours of a module's lines: that of its stream, of further outputs faint."""
        if module not in self._stream_of:
            return []
        rgb = colour(self._stream_of[module])
        one = len(set(labels)) == 1
        return [rgb if one or i == 0 else faint(rgb) for i in range(len(labels))]

    def _powers(self, columns: SignalColumns) -> Iterator[Curve]:
        """Signals that fall through several powers of ten."""
        outputs = columns["y"].shape[2]
        for name, path in POWERS.items():
            values = power_of_ten(columns[name].astype(np.float64).reshape(len(columns), -1))
            yield Curve(path, line_labels(SIGNALS[name], 0, outputs)[: values.shape[1]], values)

    def _decision(self, columns: SignalColumns) -> Iterator[Curve]:
        """Reward and value of each shown stream."""
        reward, value = columns["R"], columns["Q"]
        for s in self._streams:
            place, names, rgbs = part(self._spec.streams, s), [self._spec.streams[s]], [colour(s)]
            if reward.size:
                stay = 1000 * reward[:, s, 0, s]
                yield Curve(f"decision/R_stay/{place}", names, stay, rgbs)
            advantage = 1000 * (value[:, s, 0] - value[:, s, 1])
            yield Curve(f"decision/advantage/{place}", names, advantage, rgbs)

    def _gate(self, columns: SignalColumns) -> Iterator[Curve]:
        """Each frozen module's band of 2 SD, whose blocks it knows."""
        mean, width = columns["band_mean"], 2 * columns["band_sd"]
        edges = np.concatenate([mean - width, mean + width], axis=2)
        for i in range(edges.shape[1]):
            labels = [f"band of module {i + 1}"] * edges.shape[2]
            yield Curve(f"gate/band/{i + 1}", labels, edges[:, i], [GREY] * len(labels), width=1.0)

    def _met(self, columns: SignalColumns) -> Iterator[Curve]:
        """How far each rule to save a module is met."""
        for i, rule in enumerate(self._rules):
            yield Curve(
                f"{RULES}/{rule.signal}", [rule.ratio], power_of_ten(rule.met(columns)), number=i
            )

    def _attention(self, columns: SignalColumns) -> Iterator[Curve]:
        """Share of the recent blocks in which each shown stream was watched."""
        watched = columns["stream"][:, None] == np.array(self._streams)
        all_of_them = np.concatenate([self._recent, watched])
        sums = np.cumsum(all_of_them, axis=0)
        end = np.arange(len(self._recent), len(all_of_them))
        before = end - RECENT
        shares = sums[end] - np.where(before[:, None] < 0, 0, sums[np.maximum(before, 0)])
        self._recent = all_of_them[-RECENT:]
        names = [self._spec.streams[s] for s in self._streams]
        values = shares / np.minimum(end + 1, RECENT)[:, None]
        yield Curve("decision/attention", names, values, [colour(s) for s in self._streams])

    def _of_streams(self, columns: SignalColumns) -> Iterator[Curve]:
        """Of each shown stream its signals in its own blocks, and its interest in all.

        Signals are NaN where the stream's candidate was not tested yet, so that no line leads from
        one candidate to the next; interest is where the stream was hardly watched.
        """
        for s in self._streams:
            own, name = columns["stream"] == s, self._spec.streams[s]
            place, rgb = part(self._spec.streams, s), colour(s)
            untested = np.isnan(columns["tested"][own])
            for signal in OF_STREAM if own.any() else ():
                values = power_of_ten(np.where(untested, np.nan, columns[signal][own]))
                rgbs = [faint(rgb) if signal == "fitted" else rgb]
                labels = [f"{SIGNALS[signal].symbol} {name}"]
                yield Curve(f"streams/log_{signal}/{place}", labels, values, rgbs, rows=own)
            interest = columns["interest"][:, s]
            promised = np.where(interest < HARDLY_WATCHED, interest, np.nan)
            yield Curve(f"streams/interest/{place}", [name], promised, [rgb])

    def _tensors(self, columns: SignalColumns) -> None:
        kept = np.ones(len(columns), dtype=bool)
        if len(self._spec.streams) > len(self._streams):
            kept = columns.iterations % SPARSE == 0
        for signal in SIGNALS.values():
            value = columns[signal.name]
            if signal.show == "heat" and value.size and kept.any():
                names = [AXES[d] for d in signal.dims]
                if names.count("stream") > 1:
                    names[-1] = "next stream"
                column = self._column(f"signals/{signal.name}", self._target.tensors, names)
                column.add(columns.frames[kept], columns.iterations[kept], value[kept])

    def _table(self, columns: SignalColumns) -> None:
        """R and Q as tables, now and then."""
        kept = np.flatnonzero(columns.iterations % SPARSE == 0)
        reward, value = columns["R"], columns["Q"]
        if not reward.size or not len(kept):
            return
        shown = self._streams[:MOST_IN_TABLE]
        names = [label(self._spec.streams[s]) for s in shown]
        texts = [decision_text(names, reward[i][shown][:, :, shown], value[i][shown]) for i in kept]
        kinds = [rr.MediaType.MARKDOWN] * len(texts)
        self._send(
            columns, kept, DECISION_TABLE, rr.TextDocument.columns(text=texts, media_type=kinds)
        )

    def _name(self, columns: SignalColumns) -> None:
        """Put a frame around what is watched, in the colour and with the name of its stream."""
        turns = np.flatnonzero(np.diff(columns["stream"], prepend=self._named))
        if not self._spec.images or not len(turns):
            return
        if self._named < 0:
            height, width = self._spec.frame_shape
            frame = rr.Boxes2D(mins=[[0, 0]], sizes=[[width, height]], show_labels=True)
            self._target.log(WATCHED_NAME, frame)
        streams = columns["stream"][turns].tolist()
        self._named = streams[-1]
        labels = [label(self._spec.streams[s]) for s in streams]
        colours = packed_all([colour(s) for s in streams])
        names = rr.Boxes2D.columns(labels=labels, colors=colours)
        self._send(columns, turns, WATCHED_NAME, names)

    def _saved(self, columns: SignalColumns, saved: IntArray) -> None:
        """Mark the value of the signal that must come down where a module was saved."""
        name = "learning_error" if self._by_progress else "eta_dot"
        path = "streams/saved" if self._by_progress else "abstraction/saved"
        stood = power_of_ten(columns[name]).reshape(len(columns), -1)[saved, :1]
        column = self._column(path, partial(Column, self._target), saved_mark())
        column.add(columns.frames[saved], columns.iterations[saved], stood)

    def _send(self, columns: SignalColumns, rows: IntArray, path: str, values: Any) -> None:
        self._target.send(path, columns.frames[rows], columns.iterations[rows], values)

    def _column(self, path: str, make: Callable[..., Column], *how: Any, **more: int) -> Column:
        """The column of an entity, made when it is first needed."""
        if path not in self._columns:
            self._columns[path] = make(path, *how, **more)
        return self._columns[path]


def lines_of(header: RunHeader) -> Iterator[tuple[str, str, float]]:
    """Entity, label and value of each line that is crossed where something is learned."""
    if header.by_progress and header.settled is not None:
        change, error = header.settled
        yield "streams/settled", "settled below", math.log10(change)
        yield "streams/threshold", "learned below", math.log10(error)
    places = {
        "eta_dot": "abstraction/delta",
        "roc_error": "gate/clustering",
        "share": "gate/novel_share",
        "variance": "abstraction/min_variance",
    }
    rules = rules_of(header)
    for rule in rules:
        value = math.log10(rule.threshold) if rule.signal == "eta_dot" else rule.threshold
        name = "δ" if rule.signal == "eta_dot" else f"{rule.threshold:g}"
        yield places[rule.signal], f"{name}: saved {rule.side}", value
    if rules:
        yield f"{RULES}/met", "saved above", 0.0
