"""Data of a report on a run, read in one pass over its log."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.errors import CdmisfaError, LogDamagedError
from cdmisfa.modules import Module
from replay.module_outputs import ModuleOutputs, Subsample
from replay.runs.folders import read_run_json
from replay.runs.log import (
    EVENT_TOPIC,
    SIGNALS_TOPIC,
    TRUTH_TOPIC,
    VALUES_TOPIC,
    WATCHED_TOPIC,
    Batch,
    Event,
    read_batches,
)
from replay.runs.run import StoredRun, Tally
from replay.truth_fits import TruthFit, truth_fits

TOPICS = (SIGNALS_TOPIC, WATCHED_TOPIC, VALUES_TOPIC, TRUTH_TOPIC, EVENT_TOPIC)

# Frames on which a module's outputs are drawn and fitted: more dots would overlap in a plot.
MOST_OUTPUTS = 2000

# Number of last frames of a stream on which all outputs of its module are drawn side by side.
RECENT = 80

# Number of last frames that the card of a stream of numbers shows.
VALUES = 200

# Largest number of modules whose outputs are computed: the time to read a run grows with it.
MOST_MODULES = 40

# Largest number of listed events: the first and the last of a run.
MOST_EVENTS = 400


class ModuleData:
    """A module and its outputs on the logged frames of its own stream, before and after its save.

    Attributes:
        frozen: the module.
        stream: sums and extremes over all frames.
        after: number of logged frames of the stream after its save.
        outputs: (n,) frames, (n, J) outputs and (n, D) truth, thinned; NaN where it is unknown.
        frames: (n,) frames, (n, ...) values and (n,) first outputs, thinned further.
        recent: (n,) frames and (n, J) outputs at the end.
    """

    def __init__(self, frozen: Module, spec: SourceSpec, frames: int) -> None:
        self.frozen, self._spec, self.after = frozen, spec, 0
        self.stream = ModuleOutputs(frozen, spec)
        self.outputs, self.frames = Subsample(MOST_OUTPUTS), Subsample(frames)
        outputs = np.empty((0, len(frozen.eta)))
        self.recent: tuple[NDArray[Any], NDArray[Any]] = np.empty(0, np.int64), outputs

    def add(self, batch: Batch) -> None:
        """Add the outputs on the next batch of the log."""
        for t, frames, y in self.stream.take(batch):
            blocks = batch.blocks
            self.after += int((blocks.iterations[blocks.places(t)] > self.frozen.iteration).sum())
            truth = np.full((len(t), len(self._spec.truth)), np.nan)
            for at, values in batch.truth if self._spec.truth else ():
                row = np.minimum(np.searchsorted(at, t), len(at) - 1)
                known = at[row] == t
                truth[known] = values[row[known]]
            self.outputs.add(t, y, truth)
            self.frames.add(t, frames, y[:, 0])
            old_t, old_y = self.recent
            self.recent = np.append(old_t, t)[-RECENT:], np.concatenate([old_y, y])[-RECENT:]

    def truth_fits(self) -> list[TruthFit]:
        """Return which true quantities the first output follows, the best first."""
        if not self._spec.truth or not self.outputs.columns:
            return []
        _, y, truth = self.outputs.columns
        known = np.isfinite(truth).all(axis=1)
        return truth_fits(self._spec.truth, truth[known], y[known, 0])

    def correlation(self, other: ModuleData) -> float:
        """Return |r| of the first outputs of this module and another one, on this one's frames."""
        kind, kind_other = (self._spec.kind(m.frozen.stream_index) for m in (self, other))
        if not self.frames.columns or len(self.frames.columns[0]) < 8 or kind != kind_other:
            return 0.0
        _, frames, y = self.frames.columns
        y_other = other.frozen.transform(frames)[:, 0]
        if not (np.std(y) > 0 and np.std(y_other) > 0):
            return 0.0
        return float(abs(np.corrcoef(y, y_other)[0, 1]))

    @property
    def images(self) -> bool:
        """Whether the frames of its stream are images."""
        return self._spec.of(self.frozen.stream_index).images


class RunData:
    """A run, read once with memory that does not grow with its length.

    Args:
        path: the run's folder, or its log.
        frames: number of watched frames to keep.

    Raises:
        UsageError: the run does not exist.
        LogDamagedError: not even its header can be read.

    Attributes:
        document: its run.json; empty if there is none.
        outline: outline of its signals.
        events: the first and the last.
        modules: at most `MOST_MODULES`.
        watched: (n,) frames and (n, *frame_shape) values, thinned; none if frames differ in shape.
        last: the last image of each stream, or its last rows of numbers.
        problems: a sentence for each damage or missing file.
        damage: sentences about damage.
    """

    def __init__(self, path: Path, frames: int) -> None:
        run = StoredRun(path)
        self.path, self.header, self.spec = run.log.parent, run.header, run.header.spec
        self.document: Mapping[str, Any] = read_run_json(self.path)
        self.problems: list[str] = []
        modules: tuple[Module, ...] = ()
        if not run.result:
            self.problems.append(
                "The run was interrupted or is still learning: it has no run.json. "
                "Continue it with cdmisfa learn --resume."
            )
        try:
            modules = run.modules[:MOST_MODULES]
        except CdmisfaError as error:
            if run.result:
                self.problems.append(str(error))
        few = min(max(frames // max(len(modules), 1), 24), 96)
        self.modules = [ModuleData(module, self.spec, few) for module in modules]
        self.watched, self.last = Subsample(frames), dict[int, NDArray[Any]]()
        self.events: list[Event] = []
        tally = Tally(self.header)
        try:
            for batch in read_batches(run.log, self.header, topics=TOPICS):
                for columns in batch.signals:
                    tally.add(columns)
                self._add(batch)
        except LogDamagedError as error:
            self.problems.append(f"The log is damaged; this page shows its readable part: {error}")
        self.damage = self.problems[0 if run.result else 1 :]
        self.outline = tally.outline()

    def _add(self, batch: Batch) -> None:
        self.events += batch.events
        if len(self.events) > 2 * MOST_EVENTS:
            del self.events[MOST_EVENTS // 2 : -MOST_EVENTS // 2]
        for t, frames in batch.watched if len(batch.blocks.starts) else ():
            if not self.spec.kinds:
                self.watched.add(t, frames)
            streams = batch.blocks.streams[batch.blocks.places(t)]
            for s in np.unique(streams).tolist():
                rows = frames[streams == s][-VALUES:]
                if self.spec.of(s).images:
                    self.last[s] = rows[-1].copy()
                else:
                    self.last[s] = np.concatenate([self.last.get(s, rows[:0]), rows])[-VALUES:]
        for module in self.modules:
            module.add(batch)

    @property
    def result(self) -> Mapping[str, Any]:
        """The `result` of run.json; empty if the run was interrupted."""
        result = self.document.get("result")
        return result if isinstance(result, Mapping) else {}
