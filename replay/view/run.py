"""Write a run into a Rerun recording: every signal unchanged, and curves derived from signals.

`/signals/<name>` has the values of a signal for every iteration, as in run.mcap. A signal that the
run never has gets no entity. Lines are interrupted where their stream was not attended.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from cdmisfa.core.signals import SIGNALS, Signal
from cdmisfa.modules import Module
from replay.palette import GREY, RgbOrRgba, colour, faint, packed_all, pale
from replay.runs.columns import SignalColumns, has_values
from replay.runs.log import Batch, RunHeader
from replay.runs.run import Outline, rules_of
from replay.view.modules import ModulesView, Weights, saved_mark
from replay.view.scene import world_of_run
from replay.view.state_timelines import StateTimelines
from replay.view.writer import WIDTH, Writer, changes, drawable, for_stream, part, power_of_ten

# Signals that are timelines of the view, not curves.
TIMELINES = ("iteration", "t", "log_time")

# Index of the first color of signals that share a plot with another signal.
BESIDE = {"expert": 1, "reward": 2, "gate_mean": 1, "gate_sd": 2, "roc_error": 1}

# Signals that are also drawn as log10, as they fall over several powers of ten.
POWERS = ("eta_dot", "xi")

# Signals of the attended stream: drawn as log10, one line a stream through its blocks.
OF_STREAM = ("learning_error", "tested", "fitted", "change")

# Signals whose name spells out their symbol, which alone labels their lines.
SPELLED = ("y", "y_frozen", "eta", "eta_dot", "eta_inst", "eta_inst_frozen", "xi", "xi_dot")

# Interest of a stream that was hardly attended is set to a value above this, and is not drawn.
HARDLY_WATCHED = 1000.0

# Blocks over which the share of each stream is averaged; the titles of panels state 50.
SHARE_BLOCKS = 50

WATCHED = "world/watched"
WATCHED_NAME = f"{WATCHED}/name"


class RunView:
    """Writes a run into a view.

    Args:
        writer: writer of the Rerun recording.
        header: header of the run's log.
        streams: the streams with lines and state timelines.
        folder: folder of the run.
        every: frames from one pose of the scene to the next.
        modules: modules of the run; empty if they are unknown.
        piece: see `StateTimelines`.

    Attributes:
        modules: the view of the modules.
        world: the view of the simulated world; None if the run has none.
    """

    def __init__(
        self,
        writer: Writer,
        header: RunHeader,
        streams: Sequence[int],
        folder: Path,
        *,
        every: int,
        modules: Sequence[Module] = (),
        piece: int | None = None,
    ) -> None:
        self._writer, by_progress = writer, header.by_progress
        self._timelines = StateTimelines(writer, streams, by_progress=by_progress, piece=piece)
        self.modules = ModulesView(writer, modules, by_progress=by_progress)
        self.world, notes = world_of_run(writer, header, folder, streams, every)
        self._writers: list[Any] = [
            SignalCurves(writer, header, streams),
            Inputs(writer),
            self._timelines,
            Weights(writer, by_progress=by_progress),
            self.modules,
            *([] if self.world is None else [self.world]),
        ]
        for note in notes:
            writer.event(0, 0, note, "WARN")

    def take(self, batch: Batch) -> None:
        """Write the messages of some iterations."""
        for writer in self._writers:
            writer.take(batch)

    def finish(self, outline: Outline) -> None:
        """End the state timelines, write the modules, and send all buffered rows."""
        if outline.iterations:
            self._timelines.end(outline.end, int(outline.blocks.iterations[-1]))
        for note in self.modules.finish(outline):
            self._writer.event(outline.end, outline.iterations, note, "WARN")
        self._writer.flush()


class Inputs:
    """Writes the attended frames, the ground truth, and events.

    Args:
        writer: writer of the Rerun recording.
    """

    def __init__(self, writer: Writer) -> None:
        self._writer, self._spec, self._named = writer, writer.spec, -1
        if self._spec.images:
            height, width = self._spec.frame_shape
            writer.log(
                WATCHED_NAME, rr.Boxes2D(mins=[[0, 0]], sizes=[[width, height]], show_labels=True)
            )

    def take(self, batch: Batch) -> None:
        """Write the messages of some iterations."""
        for frames, values in batch.watched:
            iterations = batch.blocks.iteration(frames)
            if not self._spec.kinds:
                self._writer.frames(WATCHED, (frames, iterations), values, 0)
                continue
            streams = batch.blocks.streams[batch.blocks.places(frames)]
            for s in np.unique(streams).tolist():
                at, place = streams == s, for_stream(WATCHED, self._spec, s)
                self._writer.frames(place, (frames[at], iterations[at]), values[at], s)
        for frames, truth in batch.truth if self._spec.truth else ():
            at = frames, batch.blocks.iteration(frames)
            self._writer.lines("world/truth", self._spec.truth, at, truth, gap=1)
        for columns in batch.signals if self._spec.images else ():
            self._name(columns)
        for event in batch.events:
            self._writer.event(event.t, event.iteration, event.text, event.level)

    def _name(self, columns: SignalColumns) -> None:
        """Put a border around the attended image, with color and name of its stream."""
        turns = changes(columns["stream"], self._named)
        if not len(turns):
            return
        streams = columns["stream"][turns].tolist()
        self._named = streams[-1]
        labels = [drawable(self._spec.streams[s]) for s in streams]
        boxes = rr.Boxes2D.columns(labels=labels, colors=packed_all([colour(s) for s in streams]))
        self._writer.send(WATCHED_NAME, (columns.frames[turns], columns.iterations[turns]), boxes)


class Curve(NamedTuple):
    """Lines of a plot: values of the records that `of` selects, or of each of their frames."""

    path: str
    names: Sequence[str]
    values: NDArray[Any]
    rgbs: Sequence[RgbOrRgba] = ()
    of: Any = slice(None)
    per_frame: bool = False
    width: float = WIDTH


class SignalCurves:
    """Writes the signals of a run as curves.

    Args:
        writer: writer of the Rerun recording.
        header: header of the run's log.
        streams: the streams with lines.
    """

    def __init__(self, writer: Writer, header: RunHeader, streams: Sequence[int]) -> None:
        self._writer, self._names, self._streams = writer, header.spec.streams, list(streams)
        self._by_progress, self._rules = header.by_progress, rules_of(header)
        self._thresholds = list(thresholds_of(header))
        self._recent = np.zeros((0, len(streams)), dtype=bool)
        self._stream_of: dict[int, int] = {}

    def take(self, batch: Batch) -> None:
        """Write the signals of some iterations."""
        for columns in batch.signals:
            for curve in self._curves(columns):
                frames, iterations = (at[curve.of] for at in columns.times(curve.per_frame))
                values = curve.values.reshape(len(frames), -1)
                gap = 1 if curve.per_frame else columns.tau
                how = curve.path, curve.names, (frames, iterations), values, curve.rgbs
                self._writer.lines(*how, width=curve.width, gap=gap)
            for path, name, value in self._thresholds:
                ends = columns.frames[[0, -1]], columns.iterations[[0, -1]]
                self._writer.lines(path, [name], ends, np.full((2, 1), value), [GREY])
            saved = np.flatnonzero(columns["saved"])
            if len(saved):  # mark the save of a module on the value that must fall before it
                falls = "learning_error" if self._by_progress else "eta_dot"
                place = "streams/saved" if self._by_progress else "abstraction/saved"
                values = power_of_ten(columns[falls]).reshape(len(columns), -1)[saved, :1]
                at = columns.frames[saved], columns.iterations[saved]
                self._writer.buffer(place, at, values, saved_mark())

    def _curves(self, columns: SignalColumns) -> Iterator[Curve]:
        yield from self._signals(columns)
        yield from self._of_streams(columns) if self._by_progress else self._decision(columns)
        yield self._attention(columns)
        yield from self._learning(columns)

    def _signals(self, columns: SignalColumns) -> Iterator[Curve]:
        """Yield every signal's values as they are, except R and Q."""
        for i in np.flatnonzero(columns["saved"]).tolist():
            self._stream_of[int(columns["module"][i])] = int(columns["stream"][i])
        outputs = columns["y"].shape[2]
        for signal in SIGNALS.values():
            value, path = columns[signal.name], f"signals/{signal.name}"
            if signal.name in TIMELINES or signal.show == "heat":
                continue
            if value.dtype.kind == "i" and not has_values(signal.name, value):
                continue
            per_frame, rgbs = "T" in signal.dims, list[RgbOrRgba]()
            if signal.dims.startswith("M"):
                for i in range(1, value.shape[1] + 1):
                    names = line_names(signal, i, outputs)
                    if i in self._stream_of:
                        rgb = colour(self._stream_of[i])
                        rgbs = [rgb, *(faint(rgb) for _ in names[1:])]
                    yield Curve(f"{path}/{i}", names, value[:, i - 1], rgbs, per_frame=per_frame)
            elif signal.dims == "S":
                rgbs = [colour(s) for s in range(len(self._names))]
                yield Curve(path, self._names, value, rgbs)
            else:
                names, first = line_names(signal, 0, outputs), BESIDE.get(signal.name, 0)
                rgbs = [pale(first + i) for i in range(len(names))]
                yield Curve(path, names, value, rgbs, per_frame=per_frame)

    def _learning(self, columns: SignalColumns) -> Iterator[Curve]:
        """Yield the values that must fall or rise before a save, and the bands of saved modules."""
        outputs = columns["y"].shape[2]
        for name in POWERS:
            values = power_of_ten(columns[name].astype(np.float64).reshape(len(columns), -1))
            names = line_names(SIGNALS[name], 0, outputs)[: values.shape[1]]
            yield Curve(f"abstraction/log_{name}", names, values)
        mean, width = columns["band_mean"], 2 * columns["band_sd"]
        edges = np.concatenate([mean - width, mean + width], axis=2)
        for i in range(edges.shape[1]):
            names, greys = [f"band of module {i + 1}"] * edges.shape[2], [GREY] * edges.shape[2]
            yield Curve(f"gate/band/{i + 1}", names, edges[:, i], greys, width=1.0)
        for i, rule in enumerate(self._rules):
            values = power_of_ten(rule.met(columns))
            yield Curve(f"rules/{rule.signal}", [rule.ratio], values, [pale(i)])

    def _decision(self, columns: SignalColumns) -> Iterator[Curve]:
        """Yield reward and value of each shown stream."""
        reward, value = columns["R"], columns["Q"]
        for s in self._streams:
            place, names, rgbs = part(self._names, s), [self._names[s]], [colour(s)]
            if reward.size:
                yield Curve(f"decision/R_stay/{place}", names, 1000 * reward[:, s, 0, s], rgbs)
            advantage = 1000 * (value[:, s, 0] - value[:, s, 1])
            yield Curve(f"decision/advantage/{place}", names, advantage, rgbs)

    def _attention(self, columns: SignalColumns) -> Curve:
        """Return the share of recent blocks in which each visible stream was attended."""
        watched = columns["stream"][:, None] == np.array(self._streams)
        blocks = np.concatenate([self._recent, watched])
        sums = np.cumsum(blocks, axis=0)
        end = np.arange(len(self._recent), len(blocks))
        before = end - SHARE_BLOCKS
        shares = sums[end] - np.where(before[:, None] < 0, 0, sums[np.maximum(before, 0)])
        self._recent = blocks[-SHARE_BLOCKS:]
        values = shares / np.minimum(end + 1, SHARE_BLOCKS)[:, None]
        names, rgbs = zip(*((self._names[s], colour(s)) for s in self._streams), strict=True)
        return Curve("decision/attention", names, values, rgbs)

    def _of_streams(self, columns: SignalColumns) -> Iterator[Curve]:
        """Yield signals of each shown stream in its own blocks, and its interest in all.

        Signals are NaN where the stream's candidate was not tested yet, so that no line leads from
        one candidate to the next; interest is NaN where the stream was hardly attended.
        """
        for s in self._streams:
            watched, name = columns["stream"] == s, self._names[s]
            place, rgb = part(self._names, s), colour(s)
            untested = np.isnan(columns["tested"][watched])
            for signal in OF_STREAM if watched.any() else ():
                values = power_of_ten(np.where(untested, np.nan, columns[signal][watched]))
                rgbs = [faint(rgb) if signal == "fitted" else rgb]
                yield Curve(f"streams/log_{signal}/{place}", [name], values, rgbs, watched)
            interest = columns["interest"][:, s]
            values = np.where(interest < HARDLY_WATCHED, interest, np.nan)
            yield Curve(f"streams/interest/{place}", [name], values, [rgb])


def line_names(signal: Signal, module: int, outputs: int) -> list[str]:
    """Return names of a signal's lines: its symbol and unit, its module from 1, its outputs."""
    name = signal.name.replace("_", " ")
    symbol = signal.symbol.replace("_i", f"_{module}") if module else signal.symbol
    if signal.name in SPELLED or (not module and symbol == name):
        text = symbol
    else:
        text = f"{symbol} {name}{f' module {module}' if module else ''}".strip()
    unit = "" if signal.unit in ("", "1") else f" [{signal.unit}]"
    if "J" not in signal.dims or outputs == 1:
        return [f"{text}{unit}"]
    return [f"{text} output {j + 1}{unit}" for j in range(outputs)]


def thresholds_of(header: RunHeader) -> Iterator[tuple[str, str, float]]:
    """Yield entity, label and value of each threshold that a curve crosses before a save."""
    change, agreement = header.number("settled"), header.number("agreement")
    if header.by_progress and change and agreement:
        yield "thresholds/change", "settled below", math.log10(change)
        yield "thresholds/learning_error", "learned below", math.log10(change + agreement)
    rules = rules_of(header)
    for rule in rules:
        value = math.log10(rule.threshold) if rule.signal == "eta_dot" else rule.threshold
        name = "δ" if rule.signal == "eta_dot" else f"{rule.threshold:g}"
        yield f"thresholds/{rule.signal}", f"{name}: saved {rule.side}", value
    if rules:
        yield "rules/met", "saved above", 0.0
