"""A run as rows of a Rerun recording: every signal as it is, and what eyes need besides.

`/signals/<name>` holds each signal's values for every iteration, read back they are
those of run.mcap; of a signal that the run never tells there is nothing. Where frames are missing,
lines of values a frame have a row of NaN. `/world`, `/lanes`,
`/decision`, `/gate`, `/abstraction`, `/streams` and `/modules` show the same for a person.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.modules import Module
from cdmisfa.core.signals import SIGNALS, Signal
from replay.palette import BRICK, GREY, MIST, Rgb, colour, darker, packed, packed_all, pale, shade
from replay.runs.columns import Blocks, SignalColumns, has_values
from replay.runs.log import Batch, RunHeader
from replay.runs.run import Outline
from replay.view.columns import (
    FRAME,
    ITERATION,
    LOG_TIME,
    TIMELINE_SIGNALS,
    Column,
    TensorColumn,
    frames_column,
    line_column,
    power_of_ten,
    tensors,
    time_columns,
)
from replay.view.labels import label, part
from replay.view.lanes import Lanes
from replay.view.streams import add_streams, thresholds
from replay.view.summary import decision_text

AXES = {"S": "stream", "A": "action", "J": "output"}
"""Names of tensors' dimensions; the second S of a tensor is the next stream."""

BESIDE = {"expert": 1, "reward": 2, "gate_mean": 1, "gate_sd": 2, "roc_error": 1}
"""Colours of signals that are drawn beside another one."""

POWERS = {"eta_dot": "abstraction/log_eta_dot", "xi": "abstraction/log_xi"}
"""Entities of signals drawn as powers of ten: they fall through several."""

MILLI = 1000.0
"""Of rewards and values: they are small numbers."""

SPELLED = ("y", "y_frozen", "eta", "eta_dot", "eta_inst", "eta_inst_frozen", "xi", "xi_dot")
"""Signals whose name is their symbol, spelled out."""

RECENT = 50
"""Blocks over which the share of each stream is taken."""

SPARSE = 10
"""Iterations between two tables of R and Q, and between two tensors of very many streams."""

MOST_IN_TABLE = 6
"""Streams of these tables."""

WATCHED_NAME = "world/watched/name"
DECISION_TABLE = "decision/table"

WIDTH = 1.5
"""Of lines."""


class RunView:
    """Writes a run into a recording.

    Args:
        recording: the recording.
        header: what stands at the beginning of the run's log.
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
        self._recording = recording
        self._by_progress = header.by_progress
        self._thresholds = thresholds(header) if header.by_progress else {}
        if header.delta is not None and header.delta > 0:
            self._thresholds["abstraction/delta"] = "δ", math.log10(header.delta)
        self._every = every
        self._spec = header.spec
        self._columns: dict[str, Column] = {}
        self._streams = streams
        self._blocks = Blocks.concatenated(())
        self._recent = np.zeros((0, len(streams)), dtype=bool)
        self._stream_of: dict[int, int] = {}
        self._named = -1
        self._lanes = Lanes(
            recording, self._spec, streams, by_progress=header.by_progress, piece=piece
        )

    def take(self, batch: Batch) -> None:
        """Take what a log holds of some iterations."""
        self._blocks = batch.blocks
        for columns in batch.signals:
            self._add(columns)
        for frames, watched in batch.watched:
            self._watched(frames, watched)
        for frames, truth in batch.truth:
            self._truth(frames, truth)
        for t, phi in batch.phi:
            (iteration,) = batch.blocks.iteration(np.array([t])).tolist()
            self.weights("abstraction/phi", t, iteration, phi)
        for event in batch.events:
            self.event(event.t, event.iteration, event.text, event.level)

    def finish(self, outline: Outline, modules: Sequence[Module]) -> None:
        """Write what is known at the end, and hand over everything that waits.

        Args:
            outline: the run in short.
            modules: the frozen modules, for their weights.
        """
        starts = {save.module: save.t for save in outline.saved}
        for module in modules:
            t = starts.get(module.index, outline.end)
            self.weights(f"modules/{module.index}/weights", t, module.iteration, module.phi)
        if outline.iterations:
            self.threshold(outline.blocks.starts[[0, -1]], outline.blocks.iterations[[0, -1]])
        self._lanes.end(outline.end)
        self.flush()

    def _add(self, columns: SignalColumns) -> None:
        """Take the records of consecutive iterations."""
        self._signals(columns)
        self._attention(columns)
        self._decision(columns)
        self._gate(columns)
        self._saved(columns)
        self._powers(columns)
        self._name(columns)
        if self._by_progress:
            add_streams(columns, self._spec.streams, self._streams, self._line)
        self._lanes.add(columns)

    def _watched(self, at: NDArray[np.int64], frames: NDArray[Any]) -> None:
        """Take (n, *frame_shape) of what the learner saw at n frames."""
        if self._spec.images:
            kept = at % self._every == 0
            if not kept.all():
                at, frames = at[kept], frames[kept]
        if len(at):
            column = self._column("world/watched", frames_column, WIDTH)
            column.add(at, self._blocks.iteration(at), frames)

    def _truth(self, at: NDArray[np.int64], values: NDArray[np.float64]) -> None:
        """Take (n, D) of what the world knows at n frames, and the learner does not."""
        if self._spec.truth:
            line = self._line("world/truth", self._spec.truth, every_frame=True)
            line.add(at, self._blocks.iteration(at), values)

    def weights(self, path: str, t: int, iteration: int, phi: NDArray[np.float64]) -> None:
        """Show (J, I) weights at an entity."""
        self._set_time(t, iteration)
        self._recording.log(path, self._picture(phi))

    def event(self, t: int, iteration: int, text: str, level: str = "INFO") -> None:
        """Say in words what happened."""
        self._set_time(t, iteration)
        level = "WARN" if level == "WARNING" else level
        self._recording.log("events", rr.TextLog(label(text), level=level))

    def threshold(self, frames: NDArray[np.int64], iterations: NDArray[np.int64]) -> None:
        """Draw the lines below which something is learned, through frames, (n,)."""
        for path, (name, value) in self._thresholds.items():
            line = self._line(path, [name], rgbs=[GREY])
            line.add(frames, iterations, np.full((len(frames), 1), value))

    def flush(self) -> None:
        """Hand over everything that waits."""
        for column in self._columns.values():
            column.flush()
        self._lanes.flush()

    def _signals(self, columns: SignalColumns) -> None:
        """Every signal's values as they are."""
        outputs = columns["y"].shape[2]
        for signal in SIGNALS.values():
            if signal.name in TIMELINE_SIGNALS:
                continue
            value, path = columns[signal.name], f"signals/{signal.name}"
            if value.dtype.kind == "i" and not has_values(signal.name, value):
                continue
            every_frame = "T" in signal.dims
            frames, iterations = columns.times(every_frame)
            if signal.show == "heat":
                self._tensor(signal, path, columns, value)
            elif signal.dims == "S":
                names = self._spec.streams
                rgbs = [colour(s) for s in range(len(names))]
                self._line(path, names, rgbs=rgbs).add(frames, iterations, value)
            elif signal.dims.startswith("M"):
                for i in range(value.shape[1]):
                    labels = _labels(signal, i + 1, outputs)
                    own, place = self._of_module(i + 1, labels), f"{path}/{i + 1}"
                    line = self._line(place, labels, rgbs=own, every_frame=every_frame)
                    line.add(frames, iterations, value[:, i].reshape(len(frames), -1))
            else:
                labels, number = _labels(signal, 0, outputs), BESIDE.get(signal.name, 0)
                line = self._line(path, labels, number, every_frame=every_frame)
                line.add(frames, iterations, value.reshape(len(frames), -1))

    def _tensor(
        self, signal: Signal, path: str, columns: SignalColumns, value: NDArray[Any]
    ) -> None:
        crowded = len(self._spec.streams) > len(self._streams)
        kept = columns.iterations % SPARSE == 0 if crowded else np.ones(len(value), dtype=bool)
        if value.size and kept.any():
            names = [AXES[d] for d in signal.dims]
            if names.count("stream") > 1:
                names[-1] = "next stream"
            column = self._column(path, TensorColumn, names)
            column.add(columns.frames[kept], columns.iterations[kept], value[kept])

    def _powers(self, columns: SignalColumns) -> None:
        """Signals that fall through several powers of ten."""
        outputs = columns["y"].shape[2]
        for name, path in POWERS.items():
            labels = _labels(SIGNALS[name], 0, outputs)
            values = columns[name].astype(np.float64).reshape(len(columns), -1)
            self._line(path, labels[: values.shape[1]]).add(*columns.times(), power_of_ten(values))

    def _name(self, columns: SignalColumns) -> None:
        """Put a frame around what is watched, in the colour and with the name of its stream."""
        turns = np.flatnonzero(np.diff(columns["stream"], prepend=self._named))
        if not self._spec.images or not len(turns):
            return
        if self._named < 0:
            height, width = self._spec.frame_shape
            frame = rr.Boxes2D(mins=[[0, 0]], sizes=[[width, height]], show_labels=True)
            self._recording.log(WATCHED_NAME, frame, static=True)
        streams = columns["stream"][turns].tolist()
        self._named = streams[-1]
        names = rr.Boxes2D.columns(
            labels=[label(self._spec.streams[s]) for s in streams],
            colors=packed_all([colour(s) for s in streams]),
        )
        times = time_columns(self._spec, columns.frames[turns], columns.iterations[turns])
        self._recording.send_columns(WATCHED_NAME, times, names)

    def _of_module(self, module: int, labels: Sequence[str]) -> list[Rgb] | None:
        """The colours of a module's lines: that of its stream, of further outputs dimmer."""
        if module not in self._stream_of:
            return None
        rgb = colour(self._stream_of[module])
        one = len(set(labels)) == 1
        return [rgb if one or i == 0 else darker(rgb) for i in range(len(labels))]

    def _attention(self, columns: SignalColumns) -> None:
        """How much of the recent blocks each shown stream was watched."""
        watched = columns["stream"][:, None] == np.array(self._streams)
        all_of_them = np.concatenate([self._recent, watched])
        sums = np.cumsum(all_of_them, axis=0)
        end = np.arange(len(self._recent), len(all_of_them))
        before = end - RECENT
        shares = sums[end] - np.where(before[:, None] < 0, 0, sums[np.maximum(before, 0)])
        self._recent = all_of_them[-RECENT:]
        names = [self._spec.streams[s] for s in self._streams]
        line = self._line("decision/attention", names, rgbs=[colour(s) for s in self._streams])
        line.add(*columns.times(), shares / np.minimum(end + 1, RECENT)[:, None])

    def _decision(self, columns: SignalColumns) -> None:
        """Reward and value of each shown stream, as lines in the streams' colours."""
        reward, value = columns["R"], columns["Q"]
        for s in self._streams:
            place, rgbs = part(self._spec.streams, s), [colour(s)]
            names = [self._spec.streams[s]]
            if reward.size:
                line = self._line(f"decision/R_stay/{place}", names, rgbs=rgbs)
                line.add(*columns.times(), MILLI * reward[:, s, 0, s])
            line = self._line(f"decision/advantage/{place}", names, rgbs=rgbs)
            line.add(*columns.times(), MILLI * (value[:, s, 0] - value[:, s, 1]))
        kept = np.flatnonzero(columns.iterations % SPARSE == 0)
        if reward.size and len(kept):
            names = [label(self._spec.streams[s]) for s in self._streams[:MOST_IN_TABLE]]
            shown = list(self._streams[:MOST_IN_TABLE])
            texts = [
                decision_text(names, reward[i][shown][:, :, shown], value[i][shown]) for i in kept
            ]
            times = time_columns(self._spec, columns.frames[kept], columns.iterations[kept])
            self._recording.send_columns(
                DECISION_TABLE,
                times,
                rr.TextDocument.columns(
                    text=texts, media_type=[rr.MediaType.MARKDOWN] * len(texts)
                ),
            )

    def _gate(self, columns: SignalColumns) -> None:
        """Each frozen module's band of 2 SD, whose blocks it knows."""
        mean, width = columns["band_mean"], 2 * columns["band_sd"]
        edges = np.concatenate([mean - width, mean + width], axis=2)
        for i in range(edges.shape[1]):
            labels = [f"band of module {i + 1}"] * edges.shape[2]
            self._line(f"gate/band/{i + 1}", labels, rgbs=[GREY] * len(labels), width=1.0).add(
                *columns.times(), edges[:, i]
            )

    def _saved(self, columns: SignalColumns) -> None:
        """Where that which must come down stood when a module was saved."""
        saved = columns["saved"]
        self._stream_of |= zip(
            columns["module"][saved].tolist(), columns["stream"][saved].tolist(), strict=True
        )
        path, name = "abstraction/saved", "eta_dot"
        if self._by_progress:
            path, name = "streams/saved", "learning_error"
        if saved.any():
            stood = columns[name][saved].reshape(int(saved.sum()), -1)[:, :1]
            if name in POWERS:
                stood = power_of_ten(stood)
            self._column(path, _marks).add(columns.frames[saved], columns.iterations[saved], stood)

    def _picture(self, phi: NDArray[np.float64]) -> Any:
        """(J, I) weights as images below one another, as bars, or as a tensor."""
        shape = self._spec.frame_shape
        if self._spec.images and phi.shape[1] == shape[0] * shape[1]:
            return rr.Image(shade(phi.reshape(-1, shape[1])))
        if phi.size <= 256:
            return rr.BarChart(tensors(phi.reshape(1, -1)), color=packed(MIST))
        return rr.Tensor(phi.copy(), dim_names=("output", "input"))

    def _set_time(self, t: int, iteration: int) -> None:
        self._recording.set_time(FRAME, sequence=t)
        self._recording.set_time(ITERATION, sequence=max(iteration, 0))
        self._recording.set_time(LOG_TIME, timestamp=np.datetime64(self._spec.time_ns(t), "ns"))

    def _line(
        self,
        path: str,
        labels: Sequence[str],
        number: int = 0,
        *,
        rgbs: Sequence[Rgb] | None = None,
        width: float = WIDTH,
        every_frame: bool = False,
    ) -> Column:
        """The column of a line or several, in the colours from `number` on."""
        one = len(set(labels)) == 1
        rgbs = rgbs or [pale(number + (0 if one else i)) for i in range(len(labels))]
        return self._column(path, line_column, labels, rgbs, width, every_frame=every_frame)

    def _column(self, path: str, make: Callable[..., Column], *how: Any, **more: bool) -> Column:
        """The column of an entity, made when it is first needed."""
        if path not in self._columns:
            self._columns[path] = make(self._recording, self._spec, path, *how, **more)
        return self._columns[path]


def _marks(recording: rr.RecordingStream, spec: SourceSpec, path: str) -> Column:
    """A column that is drawn as marks where a module was saved."""
    style = rr.SeriesPoints(
        colors=[packed(BRICK)], markers="diamond", marker_sizes=[7.0], names=["module saved"]
    )
    return Column(recording, spec, path, style)


def _labels(signal: Signal, module: int, outputs: int) -> list[str]:
    """Names of a signal's lines: its symbol and unit, its module, its outputs."""
    name = signal.name.replace("_", " ")
    if module:
        symbol = signal.symbol.replace("_i", f"_{module}")
        text = symbol if signal.name in SPELLED else f"{symbol} {name} module {module}".strip()
    elif signal.name in SPELLED or signal.symbol == name:
        text = signal.symbol
    else:
        text = f"{signal.symbol} {name}".strip()
    unit = "" if signal.unit in ("", "1") else f" [{signal.unit}]"
    if "J" not in signal.dims or outputs == 1:
        return [f"{text}{unit}"]
    return [f"{text} output {j + 1}{unit}" for j in range(outputs)]
