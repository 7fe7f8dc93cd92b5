"""A run as rows of a Rerun recording: every signal as it is, and what eyes need besides.

`/signals/<name>` holds each signal's values for every iteration, read back they are
those of run.mcap. `/world`, `/lanes`, `/decision`, `/gate`, `/abstraction` and
`/modules` show the same for a person.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from cdmisfa.modules import Module
from cdmisfa.signals import SIGNALS, BlockSignals, Signal
from replay.columns import Clock, Column, ImageColumn, TensorColumn
from replay.config import ViewConfig
from replay.labels import label, part
from replay.lanes import Lanes
from replay.outline import Outline
from replay.palette import GREY, VERMILLION, colour, packed, shade
from replay.runlog import read_events, read_phi, read_signals, read_truth, read_watched

AXES = {"S": "stream", "A": "action", "J": "output"}
"""Names of tensors' dimensions; the second S of a tensor is the next stream."""

TIMELINE_SIGNALS = ("iteration", "t", "log_time")
"""Signals that are not lines but the timelines themselves."""

BESIDE = {"expert": 1, "reward": 2, "gate_mean": 1, "gate_sd": 2}
"""Colours of signals that are drawn beside another one."""

SPARSE = 10
"""With more streams than are shown one by one, tensors are kept every so many iterations."""

AnyColumn = TypeVar("AnyColumn", bound=Column)


class RunView:
    """Writes a run into a recording.

    Args:
        recording: the recording.
        path: the run.
        outline: the run in short.
        config: how it is shown.
    """

    def __init__(
        self, recording: rr.RecordingStream, path: Path, outline: Outline, config: ViewConfig
    ) -> None:
        self._recording = recording
        self._path = path
        self._outline = outline
        self._config = config
        self._spec = outline.header.spec
        self._clock = Clock(self._spec)
        self._columns: dict[str, Column] = {}
        self._streams = outline.streams(config.streams)
        self._lanes = Lanes(recording, self._clock, self._spec.streams, self._streams)

    def write(self, modules: Sequence[Module]) -> None:
        """Write everything.

        Args:
            modules: the frozen modules, for their weights.
        """
        for signals in read_signals(self._path):
            self._signals(signals)
            self._decision(signals)
            self._gate(signals)
            self._lanes.add(signals)
        self._lanes.end(self._outline.frames)
        self._threshold()
        self._watched()
        self._truth()
        self._weights(modules)
        for event in read_events(self._path):
            self._set_time(event.t, event.iteration)
            level = "WARN" if event.level == "WARNING" else event.level
            self._recording.log("events", rr.TextLog(label(event.text), level=level))
        for column in self._columns.values():
            column.flush()

    def _signals(self, signals: BlockSignals) -> None:
        """Every signal's values as they are."""
        k, frames = signals.iteration, np.array([signals.t])
        every = frames + np.arange(len(signals.y))
        for signal in SIGNALS.values():
            if signal.name in TIMELINE_SIGNALS:
                continue
            value = np.asarray(getattr(signals, signal.name))
            path = f"signals/{signal.name}"
            if signal.show == "heat":
                self._tensor(signal, path, k, frames, value)
            elif signal.dims.startswith("M"):
                for i, part in enumerate(value, start=1):
                    at = every if "T" in signal.dims else frames
                    column = self._line(f"{path}/{i}", _labels(signal, i, self._outline.outputs), i)
                    column.add(at, k, part.reshape(len(at), -1))
            else:
                at = every if signal.dims.startswith("T") else frames
                labels = _labels(signal, 0, self._outline.outputs)
                number = BESIDE.get(signal.name, 0)
                column = self._line(path, labels if signal.dims != "S" else None, number)
                column.add(at, k, value.reshape(len(at), -1))

    def _tensor(
        self, signal: Signal, path: str, k: int, frames: NDArray[np.int64], value: NDArray[Any]
    ) -> None:
        crowded = len(self._spec.streams) > self._config.streams
        if value.size and not (crowded and k % SPARSE):
            names = [AXES[d] for d in signal.dims]
            if names.count("stream") > 1:
                names[-1] = "next stream"
            column = self._column(
                path,
                lambda: TensorColumn(self._recording, self._clock, path, self._config.rows, names),
            )
            column.add(frames, k, value[None])

    def _decision(self, signals: BlockSignals) -> None:
        """Reward and value of each shown stream, as lines in the streams' colours."""
        frames = np.array([signals.t])
        for s in self._streams:
            name = self._spec.streams[s]
            place = part(self._spec.streams, s)
            if signals.R.size:
                line = self._line(f"decision/R_stay/{place}", [f"R stay {name}"], s)
                line.add(frames, signals.iteration, signals.R[s, 0, s].reshape(1, 1))
            line = self._line(f"decision/advantage/{place}", [f"Q stay - switch {name}"], s)
            advantage = signals.Q[s, 0] - signals.Q[s, 1]
            line.add(frames, signals.iteration, np.array([[advantage]]))

    def _gate(self, signals: BlockSignals) -> None:
        """Each frozen module's band of 2 SD, whose blocks it knows."""
        frames = np.array([signals.t])
        for i, (mean, sd) in enumerate(
            zip(signals.band_mean, signals.band_sd, strict=True), start=1
        ):
            edges = np.concatenate([mean - 2 * sd, mean + 2 * sd])
            labels = [f"band of module {i}"] * len(edges)
            band = self._line(f"gate/band/{i}", labels, i - 1, width=1.0)
            band.add(frames, signals.iteration, edges[None])

    def _threshold(self) -> None:
        """The line eta-dot must fall below, and where it did."""
        outline = self._outline
        if outline.delta is not None and outline.iterations:
            line = self._line("abstraction/delta", ["δ threshold"], 0, rgb=GREY)
            ends = np.array([0, max(outline.frames - outline.tau, 1)])
            for t, k in zip(ends, (0, outline.iterations - 1), strict=True):
                line.add(np.array([t]), k, np.array([[outline.delta]]))
        if outline.saved:
            style = rr.SeriesPoints(
                colors=[packed(VERMILLION)],
                markers="diamond",
                marker_sizes=[7.0],
                names=["module saved"],
            )
            self._recording.log("abstraction/saved", style, static=True)
            marks = self._column(
                "abstraction/saved",
                lambda: Column(
                    self._recording, self._clock, "abstraction/saved", self._config.rows
                ),
            )
            for save in outline.saved:
                marks.add(np.array([save.t]), save.iteration, np.array([save.eta_dot[:1]]))

    def _watched(self) -> None:
        """What the learner saw."""
        shape, path = self._spec.frame_shape, "world/watched"
        if len(shape) == 2:
            column = ImageColumn(self._recording, self._clock, path, self._config.rows)
            column.declare(*shape)
            self._columns[path] = column
            for t, images in read_watched(self._path):
                if t % self._config.every == 0:
                    column.add(np.array([t]), self._iteration(t), images)
            return
        labels = [f"x{i + 1}" for i in range(int(np.prod(shape)))]
        for t, values in read_watched(self._path):
            line = self._line(path, labels, 0)
            line.add(
                t + np.arange(len(values)), self._iteration(t), values.reshape(len(values), -1)
            )

    def _truth(self) -> None:
        """What the world knows and the learner did not."""
        for t, values in read_truth(self._path):
            line = self._line("world/truth", list(self._spec.truth), 0)
            line.add(t + np.arange(len(values)), self._iteration(t), values)

    def _weights(self, modules: Sequence[Module]) -> None:
        """The abstraction's weights over time, and each frozen module's."""
        for t, phi in read_phi(self._path):
            self._set_time(t, self._iteration(t))
            self._recording.log("abstraction/phi", self._picture(phi))
        for module in modules:
            t = module.iteration * self._outline.tau
            self._set_time(t, module.iteration)
            self._recording.log(f"modules/{module.index}/weights", self._picture(module.phi))

    def _picture(self, phi: NDArray[np.float64]) -> Any:
        """(J, I) weights as images below one another, as bars, or as a tensor."""
        shape = self._spec.frame_shape
        if len(shape) == 2 and phi.shape[1] == shape[0] * shape[1]:
            return rr.Image(shade(phi.reshape(-1, shape[1])))
        if phi.size <= 256:
            return rr.BarChart(phi.reshape(-1).copy())
        return rr.Tensor(phi.copy(), dim_names=("output", "input"))

    def _iteration(self, t: int) -> int:
        return t // max(self._outline.tau, 1)

    def _set_time(self, t: int, iteration: int) -> None:
        self._recording.set_time("frame", sequence=t)
        self._recording.set_time("iteration", sequence=max(iteration, 0))
        time = np.datetime64(self._spec.time_ns(t), "ns")
        self._recording.set_time("message_log_time", timestamp=time)

    def _line(
        self,
        path: str,
        labels: Sequence[str] | None,
        number: int,
        *,
        rgb: tuple[int, int, int] | None = None,
        width: float = 1.5,
    ) -> Column:
        """The column of a line, its names and colours said once."""

        def declare() -> Column:
            if labels is not None:
                shades = [rgb or colour(number + i) for i in range(len(labels))]
                if len(set(labels)) == 1:
                    shades = [rgb or colour(number)] * len(labels)
                style = rr.SeriesLines(
                    names=[label(text) for text in labels],
                    colors=[packed(c) for c in shades],
                    widths=[width] * len(labels),
                )
                self._recording.log(path, style, static=True)
            return Column(self._recording, self._clock, path, self._config.rows)

        return self._column(path, declare)

    def _column(self, path: str, make: Callable[[], AnyColumn]) -> Column:
        if path not in self._columns:
            self._columns[path] = make()
        return self._columns[path]


def _labels(signal: Signal, module: int, outputs: int) -> list[str]:
    """Names of a signal's lines: its symbol and unit, its module, its outputs."""
    name = signal.name.replace("_", " ")
    symbol = "" if signal.symbol in ("", name) else f"{signal.symbol} "
    unit = "" if signal.unit in ("", "1") else f" [{signal.unit}]"
    who = f" module {module}" if module else ""
    if "J" not in signal.dims or outputs == 1:
        return [f"{symbol}{name}{who}{unit}"]
    return [f"{symbol}{name}{who} output {j + 1}{unit}" for j in range(outputs)]
