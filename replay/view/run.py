"""A run as rows of a Rerun recording: every signal as it is, and curves for people.

`/signals/<name>` holds a signal's values for every iteration, those of run.mcap. A signal that the
run never has gets no entity. Lines end where frames, or frames of their stream, were not watched.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.signals import SIGNALS, Signal
from cdmisfa.modules import Module
from replay.palette import GREY, Colour, colour, faint, packed_all, pale
from replay.runs.columns import SignalColumns, has_values
from replay.runs.log import Batch, RunHeader
from replay.runs.run import Outline, rules_of
from replay.view.lanes import Lanes
from replay.view.modules import ModulesView, hang_weights, saved_mark, write_weights
from replay.view.rows import WIDTH, Rows, changes, label, part, power_of_ten
from replay.view.scene import world_of_run

# Signals that are the timelines.
TIMELINES = ("iteration", "t", "log_time")

# Number of the first colour of signals that are drawn beside another one.
BESIDE = {"expert": 1, "reward": 2, "gate_mean": 1, "gate_sd": 2, "roc_error": 1}

# Signals drawn as powers of ten, too: they fall through several.
POWERS = ("eta_dot", "xi")

# Signals of the watched stream: each has its line, of powers of ten, through its own blocks.
OF_STREAM = ("learning_error", "tested", "fitted", "change")

# Signals whose name is their symbol, spelled out.
SPELLED = ("y", "y_frozen", "eta", "eta_dot", "eta_inst", "eta_inst_frozen", "xi", "xi_dot")

# Interest from which on a stream promises most because it was hardly watched: it has no line.
HARDLY_WATCHED = 1000.0

# Blocks over which the share of each stream is taken.
RECENT = 50

PHI = "abstraction/phi"
WATCHED_NAME = "world/watched/name"


class RunView:
    """Writes a run into a recording.

    Args:
        rows: of the recording.
        header: of the run's log.
        streams: those that get lines and lanes of their own.
        folder: of the run.
        every: frames from one pose of the scene to the next.
        modules: of the run, where they are known.
        piece: see `Lanes`.

    Attributes:
        modules: the view of the modules.
        world: the view of the world; None where none is known.
    """

    def __init__(
        self,
        rows: Rows,
        header: RunHeader,
        streams: Sequence[int],
        folder: Path,
        *,
        every: int,
        modules: Sequence[Module] = (),
        piece: int | None = None,
    ) -> None:
        self._rows, self._spec, self._streams = rows, header.spec, list(streams)
        self._by_progress, self._rules = header.by_progress, rules_of(header)
        self._thresholds = list(thresholds_of(header))
        self._recent = np.zeros((0, len(streams)), dtype=bool)
        self._stream_of: dict[int, int] = {}
        self._named = -1
        self._phi: dict[int, FloatArray] = {}
        self._phi_stream = -1
        self._lanes = Lanes(rows, streams, by_progress=header.by_progress, piece=piece)
        self.modules = ModulesView(rows, modules)
        self.world, notes = world_of_run(rows, header, folder, streams, every)
        for note in notes:
            self.event(0, 0, note, "WARN")

    def take(self, batch: Batch) -> None:
        """Write the messages of some iterations."""
        for columns in batch.signals:
            self._signals(columns)
            self._learning(columns)
            if self._by_progress:
                self._of_streams(columns)
            else:
                self._decision(columns)
            self._attention(columns)
            self._name_watched(columns)
            self._lanes.add_blocks(columns)
            for path, name, value in self._thresholds:
                ends = columns.frames[[0, -1]], columns.iterations[[0, -1]]
                self._rows.lines(path, [name], ends, np.full((2, 1), value), [GREY])
        for frames, values in batch.watched:
            at = frames, batch.blocks.iteration(frames)
            self._rows.frames("world/watched", at, values)
        for frames, truth in batch.truth if self._spec.truth else ():
            at = frames, batch.blocks.iteration(frames)
            self._rows.lines("world/truth", self._spec.truth, at, truth, gap=1)
        self._weights(batch)
        for event in batch.events:
            self.event(event.t, event.iteration, event.text, event.level)
        self.modules.take_batch(batch)
        if self.world is not None:
            self.world.show_batch(batch)

    def finish(self, outline: Outline) -> None:
        """Write the end of lanes and the modules, and send all rows that wait."""
        if outline.iterations:
            self._lanes.end(outline.end, int(outline.blocks.iterations[-1]))
        self.modules.finish(outline)
        for note in self.modules.notes:
            self.event(outline.end, outline.iterations, note, "WARN")
        self.flush()

    def flush(self) -> None:
        """Send all rows that wait."""
        self._lanes.send_changes()
        self._rows.flush()

    def event(self, t: int, iteration: int, text: str, level: str = "INFO") -> None:
        """Log an event in words."""
        level = "WARN" if level == "WARNING" else level
        self._rows.log_at("events", t, iteration, rr.TextLog(label(text), level=level))

    def _line(
        self,
        columns: SignalColumns,
        path: str,
        names: Sequence[str],
        values: NDArray[Any],
        rgbs: Sequence[Colour] = (),
        *,
        of: Any = slice(None),
        per_frame: bool = False,
        width: float = WIDTH,
    ) -> None:
        """Draw values of the records, of some of them, or of each of their frames."""
        frames, iterations = (times[of] for times in columns.times(per_frame))
        values, gap = values.reshape(len(frames), -1), 1 if per_frame else columns.tau
        self._rows.lines(path, names, (frames, iterations), values, rgbs, width=width, gap=gap)

    def _signals(self, columns: SignalColumns) -> None:
        """Draw every signal's values as they are, except R and Q."""
        for i in np.flatnonzero(columns["saved"]).tolist():
            self._stream_of[int(columns["module"][i])] = int(columns["stream"][i])
        outputs, streams = columns["y"].shape[2], self._spec.streams
        for signal in SIGNALS.values():
            value, path = columns[signal.name], f"signals/{signal.name}"
            if signal.name in TIMELINES or signal.show == "heat":
                continue
            if value.dtype.kind == "i" and not has_values(signal.name, value):
                continue
            per_frame = "T" in signal.dims
            if signal.dims.startswith("M"):
                for i in range(1, value.shape[1] + 1):
                    names, rgbs = line_names(signal, i, outputs), list[Colour]()
                    if i in self._stream_of:
                        rgb = colour(self._stream_of[i])
                        rgbs = [rgb, *(faint(rgb) for _ in names[1:])]
                    values = value[:, i - 1]
                    self._line(columns, f"{path}/{i}", names, values, rgbs, per_frame=per_frame)
            elif signal.dims == "S":
                self._line(columns, path, streams, value, [colour(s) for s in range(len(streams))])
            else:
                names, first = line_names(signal, 0, outputs), BESIDE.get(signal.name, 0)
                rgbs = [pale(first + i) for i in range(len(names))]
                self._line(columns, path, names, value, rgbs, per_frame=per_frame)

    def _learning(self, columns: SignalColumns) -> None:
        """Draw what must fall or rise until a module is saved, and mark where one was."""
        outputs = columns["y"].shape[2]
        for name in POWERS:
            values = power_of_ten(columns[name].astype(np.float64).reshape(len(columns), -1))
            names = line_names(SIGNALS[name], 0, outputs)[: values.shape[1]]
            self._line(columns, f"abstraction/log_{name}", names, values)
        for i, rule in enumerate(self._rules):
            values = power_of_ten(rule.met(columns))
            self._line(columns, f"rules/{rule.signal}", [rule.ratio], values, [pale(i)])
        mean, width = columns["band_mean"], 2 * columns["band_sd"]
        edges = np.concatenate([mean - width, mean + width], axis=2)
        for i in range(edges.shape[1]):
            names, greys = [f"band of module {i + 1}"] * edges.shape[2], [GREY] * edges.shape[2]
            self._line(columns, f"gate/band/{i + 1}", names, edges[:, i], greys, width=1.0)
        saved = np.flatnonzero(columns["saved"])
        if len(saved):
            falls, place = ("eta_dot", "abstraction/saved")
            if self._by_progress:
                falls, place = ("learning_error", "streams/saved")
            values = power_of_ten(columns[falls]).reshape(len(columns), -1)[saved, :1]
            at = columns.frames[saved], columns.iterations[saved]
            self._rows.buffer(place, at, values, saved_mark())

    def _decision(self, columns: SignalColumns) -> None:
        """Draw reward and value of each shown stream."""
        reward, value = columns["R"], columns["Q"]
        for s in self._streams:
            place, names, rgbs = part(self._spec.streams, s), [self._spec.streams[s]], [colour(s)]
            if reward.size:
                stay = 1000 * reward[:, s, 0, s]
                self._line(columns, f"decision/R_stay/{place}", names, stay, rgbs)
            advantage = 1000 * (value[:, s, 0] - value[:, s, 1])
            self._line(columns, f"decision/advantage/{place}", names, advantage, rgbs)

    def _attention(self, columns: SignalColumns) -> None:
        """Draw the share of the recent blocks in which each shown stream was watched."""
        watched = columns["stream"][:, None] == np.array(self._streams)
        blocks = np.concatenate([self._recent, watched])
        sums = np.cumsum(blocks, axis=0)
        end = np.arange(len(self._recent), len(blocks))
        before = end - RECENT
        shares = sums[end] - np.where(before[:, None] < 0, 0, sums[np.maximum(before, 0)])
        self._recent = blocks[-RECENT:]
        values = shares / np.minimum(end + 1, RECENT)[:, None]
        names, rgbs = zip(*((self._spec.streams[s], colour(s)) for s in self._streams), strict=True)
        self._line(columns, "decision/attention", names, values, rgbs)

    def _of_streams(self, columns: SignalColumns) -> None:
        """Draw signals of each shown stream in its own blocks, and its interest in all.

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
                names = [f"{SIGNALS[signal].symbol} {name}"]
                self._line(columns, f"streams/log_{signal}/{place}", names, values, rgbs, of=own)
            interest = columns["interest"][:, s]
            values = np.where(interest < HARDLY_WATCHED, interest, np.nan)
            self._line(columns, f"streams/interest/{place}", [name], values, [rgb])

    def _name_watched(self, columns: SignalColumns) -> None:
        """Frame the watched image in the colour and with the name of its stream."""
        turns = changes(columns["stream"], self._named)
        if not self._spec.images or not len(turns):
            return
        if self._named < 0:
            height, width = self._spec.frame_shape
            frame = rr.Boxes2D(mins=[[0, 0]], sizes=[[width, height]], show_labels=True)
            self._rows.log(WATCHED_NAME, frame)
        streams = columns["stream"][turns].tolist()
        self._named = streams[-1]
        labels = [label(self._spec.streams[s]) for s in streams]
        boxes = rr.Boxes2D.columns(labels=labels, colors=packed_all([colour(s) for s in streams]))
        self._rows.send(WATCHED_NAME, (columns.frames[turns], columns.iterations[turns]), boxes)

    def _weights(self, batch: Batch) -> None:
        """Show the weights of what learns from the watched stream, as far as the log has them.

        In a run of the progress learner each stream has its candidate, and the log has the weights
        of the candidate whose stream comes next. They are shown once that stream is watched; until
        then those that its candidate had last, or none (white).
        """
        logged = dict(batch.phi)
        for columns in batch.signals:
            watched = columns["stream"]
            owners = np.where(columns["saved"], watched, columns["next_stream"])
            owners = owners if self._by_progress else watched
            rows = (columns.frames, columns.iterations, watched, owners)
            for t, iteration, s, owner in zip(*(row.tolist() for row in rows), strict=True):
                phi, shown = logged.get(t), None
                if self._by_progress and s != self._phi_stream and self._phi:
                    shown = self._phi.get(s, 0 * next(iter(self._phi.values())))
                self._phi_stream = s
                if phi is not None:
                    if not self._phi:
                        hang_weights(self._rows, PHI, len(phi))
                    self._phi[owner] = phi
                    shown = phi if owner == s else shown
                if shown is not None:
                    write_weights(self._rows, PHI, t, iteration, shown)


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
    """Yield entity, label and value of each line that is crossed where something is learned."""
    if header.by_progress and header.settled is not None:
        change, error = header.settled
        yield "thresholds/change", "settled below", math.log10(change)
        yield "thresholds/learning_error", "learned below", math.log10(error)
    rules = rules_of(header)
    for rule in rules:
        value = math.log10(rule.threshold) if rule.signal == "eta_dot" else rule.threshold
        name = "δ" if rule.signal == "eta_dot" else f"{rule.threshold:g}"
        yield f"thresholds/{rule.signal}", f"{name}: saved {rule.side}", value
    if rules:
        yield "rules/met", "saved above", 0.0
