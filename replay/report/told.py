"""What a report tells of a run, gathered in one pass over its log."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray, IntArray
from cdmisfa.core.errors import CdmisfaError, LogDamagedError
from cdmisfa.modules import Module
from replay.following import Fit, OutputHistory
from replay.outputs import OwnStream, Thinned
from replay.runs.columns import SignalColumns
from replay.runs.folders import read_run_json
from replay.runs.log import (
    EVENT_TOPIC,
    SIGNALS_TOPIC,
    TRUTH_TOPIC,
    WATCHED_TOPIC,
    Batch,
    Event,
    RunHeader,
    read_batches,
)
from replay.runs.run import Outline, Run, Tally

TOPICS = (SIGNALS_TOPIC, WATCHED_TOPIC, TRUTH_TOPIC, EVENT_TOPIC)

HEARD = 2000
"""Frames on which a module's outputs are drawn and fitted."""

NEAR = 80
"""Frames of the last stretch that is shown from near."""

PICTURES = 160
"""Pixels across of the largest picture of a frame that is kept."""

VALUES = 200
"""Frames of numbers that stand for a stream."""

MOST_MODULES = 40
"""Modules whose outputs are computed on their streams."""

MOST_EVENTS = 400
"""Events that are listed: the first and the last."""

RULES = ("variance", "novel_blocks", "novel", "module", "saved", "roc_error")
"""Signals that the rules for saving need beside those of the outline."""


@dataclass(slots=True)
class ModuleTold:
    """A module on its own stream.

    Attributes:
        heard: (n,) frames, (n, J) outputs and (n, D) truth there, thinned; NaN where not known.
        pictures: (n,) frames, (n, *frame_shape) what was seen, (n,) the first output; thinned.
        near: frames and outputs of the last stretch without a pause.
    """

    module: Module
    own: OwnStream
    heard: Thinned
    pictures: Thinned
    near: list[tuple[IntArray, FloatArray]] = field(default_factory=list)

    def fits(self, names: Sequence[str]) -> list[Fit]:
        """What its first output follows in the world, the best first."""
        if not self.heard.columns:
            return []
        t, y, truth = self.heard.columns
        known = np.isfinite(truth).all(axis=1)
        history = OutputHistory(
            self.module.index, self.module.stream_index, t[known], y[known, 0], truth[known]
        )
        return history.fits(names)


@dataclass(slots=True)
class RunTold:
    """A run as a report tells it.

    Attributes:
        document: its run.json; empty where there is none.
        seen: (n,) frames and (n, *frame_shape) what was watched, thinned.
        last: what each stream showed last: a picture, or rows of numbers.
        states: iteration, stream and code of each change of a stream's state.
        signals: those of `RULES`, of every iteration.
        problems: what is missing, and how to get it, in words.
    """

    path: Path
    header: RunHeader
    outline: Outline
    document: Mapping[str, Any]
    events: list[Event]
    modules: list[ModuleTold]
    saved: tuple[Module, ...]
    seen: Thinned
    last: dict[int, NDArray[Any]]
    states: list[tuple[int, int, int]]
    signals: dict[str, NDArray[Any]]
    problems: list[str]

    @property
    def name(self) -> str:
        """Name of its folder."""
        return self.path.resolve().name

    @property
    def result(self) -> Mapping[str, Any]:
        """What it came to; empty where it was broken off."""
        found = self.document.get("result")
        return found if isinstance(found, Mapping) else {}

    @property
    def streams(self) -> tuple[str, ...]:
        """Names of the streams."""
        return self.header.spec.streams

    @property
    def start(self) -> int:
        """Its first frame."""
        starts = self.outline.blocks.starts
        return int(starts[0]) if len(starts) else 0

    def __len__(self) -> int:
        return self.outline.iterations


def read_told(path: Path, *, frames: int) -> RunTold:
    """Read a run's log once, with memory that does not grow with its frames.

    Args:
        path: of the run.
        frames: pictures, or rows of numbers, kept of what was watched.

    Raises:
        UsageError: there is no such run.
        LogDamagedError: not even its head can be read.
    """
    run = Run(path)
    problems: list[str] = []
    modules = _modules(run, problems)
    gathered = _Gathering(run.header, modules[:MOST_MODULES], frames)
    batches = read_batches(run.log, run.header, topics=TOPICS)
    try:
        for batch in batches:
            gathered.take(batch)
    except LogDamagedError as error:
        problems.append(f"The log is damaged; what follows is what could be read: {error}")
    outline = gathered.tally.outline()
    if len(modules) < len(outline.saved) or not run.result:
        problems += _missing(run, outline, modules)
    return RunTold(
        path=run.log.parent,
        header=run.header,
        outline=outline,
        document=read_run_json(run.log.parent),
        events=gathered.events,
        modules=gathered.modules,
        saved=modules,
        seen=gathered.seen,
        last=gathered.last,
        states=gathered.states,
        signals=gathered.signals(),
        problems=problems,
    )


def _modules(run: Run, problems: list[str]) -> tuple[Module, ...]:
    try:
        return run.modules
    except CdmisfaError as error:
        if run.result:
            problems.append(f"The modules cannot be read: {error}")
        return ()


def _missing(run: Run, outline: Outline, modules: Sequence[Module]) -> Iterator[str]:
    if not run.result:
        lacks = "no run.json" if modules else "no run.json and no modules.npz"
        yield (
            f"The run was broken off before its end, or still learns: there is {lacks}. "
            "cdmisfa learn --resume goes on with it."
        )
    elif len(modules) < len(outline.saved):
        yield f"The log tells of {len(outline.saved)} modules, modules.npz holds {len(modules)}."


class _Gathering:
    """What is kept of a log while its batches come."""

    def __init__(self, header: RunHeader, modules: Sequence[Module], frames: int) -> None:
        self._spec = header.spec
        self.tally = Tally(header)
        self.events: list[Event] = []
        self.seen = Thinned(frames)
        self.last: dict[int, NDArray[Any]] = {}
        self.states: list[tuple[int, int, int]] = []
        self._state: NDArray[Any] | None = None
        self._signals: dict[str, list[NDArray[Any]]] = {name: [] for name in RULES}
        each = max(frames // max(len(modules), 1), 24)
        self.modules = [
            ModuleTold(m, OwnStream(m, header.spec), Thinned(HEARD), Thinned(min(each, 96)))
            for m in modules
        ]

    def take(self, batch: Batch) -> None:
        """Take the next batch in."""
        for columns in batch.signals:
            self._columns(columns)
        self.events += batch.events
        if len(self.events) > 2 * MOST_EVENTS:
            del self.events[MOST_EVENTS // 2 : -MOST_EVENTS // 2]
        for t, frames in batch.watched if len(batch.blocks.starts) else ():
            self.seen.add(t, frames)
            streams = batch.blocks.streams[batch.blocks.places(t)]
            for s in np.unique(streams).tolist():
                self._show(s, frames[streams == s])
        for told in self.modules:
            self._hear(told, batch)

    def _columns(self, columns: SignalColumns) -> None:
        self.tally.add(columns)
        for name, parts in self._signals.items():
            values = columns[name]
            if name == "variance" and values.shape[1:]:
                # Progress decides by the slowest output, the paper by all of them.
                first = self.tally.header.by_progress
                values = values[:, 0] if first else values.min(axis=1)
            parts.append(values.copy())
        states, iterations = columns["state"], columns.iterations
        before = states[:1] - 1 if self._state is None else self._state[None]
        changed = np.argwhere(np.diff(np.concatenate([before, states]), axis=0) != 0)
        self.states += [(int(iterations[i]), int(s), int(states[i, s])) for i, s in changed]
        self._state = states[-1].copy()

    def _show(self, stream: int, frames: NDArray[Any]) -> None:
        if self._spec.images:
            self.last[stream] = frames[-1].copy()
        else:
            before = self.last.get(stream, frames[:0])
            self.last[stream] = np.concatenate([before, frames[-VALUES:]])[-VALUES:]

    def _hear(self, told: ModuleTold, batch: Batch) -> None:
        for t, frames, y in told.own.take(batch):
            told.heard.add(t, y, _truth_at(t, batch, len(self._spec.truth)))
            told.pictures.add(t, frames, y[:, 0])
            told.near.append((t[-NEAR:].copy(), y[-NEAR:].copy()))
            if len(told.near) > 4:
                joined = zip(*told.near, strict=True)
                told.near = [tuple(np.concatenate(part)[-NEAR:] for part in joined)]  # type: ignore[list-item]

    def signals(self) -> dict[str, NDArray[Any]]:
        """The signals of `RULES`, (n,) each."""
        return {
            name: np.concatenate(parts) if parts else np.empty(0)
            for name, parts in self._signals.items()
        }


def _truth_at(t: IntArray, batch: Batch, columns: int) -> FloatArray:
    """(n, D) what the world knew at n frames; NaN where the batch does not say."""
    found = np.full((len(t), columns), np.nan)
    for frames, values in batch.truth if columns else ():
        at = np.minimum(np.searchsorted(frames, t), len(frames) - 1)
        known = frames[at] == t
        found[known] = values[at[known]]
    return found
