"""Outputs of modules on every logged frame of their streams, also before they were saved.

Signals have a module's outputs only after its save, and a learned stream is seldom attended again.
So a frozen module computes its outputs on the logged frames again.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray, IntArray
from cdmisfa.core.blocks import SourceSpec
from cdmisfa.modules import CHUNK, Module
from replay.runs.log import Batch

# Frames of a contact sheet with the least, middle and greatest output each: five fit in a row.
SAMPLE_FRAMES = 5

# Evenly spread frames from which those with the middle output are chosen.
MIDDLE_CANDIDATES = 64


class Subsample:
    """Selects at most `most` rows, spread evenly but not periodically over all rows.

    Every second or third row of something periodic would show one phase of it alone; so row i is
    selected where the fraction of i times the golden ratio is small. The selection depends neither
    on chance nor on how the rows come.

    Args:
        most: rows; when there are more, half of them go.

    Attributes:
        count: rows that came.
        step: number of rows that a selected row represents.

    Example:
        >>> rows = Subsample(4)
        >>> for start in range(0, 10, 5):
        ...     rows.add(np.arange(start, start + 5))
        >>> rows.columns[0].tolist(), rows.step
        ([0, 2, 5], 4)
    """

    def __init__(self, most: int) -> None:
        self.step, self.count, self._most = 1, 0, most
        self._rows: tuple[NDArray[Any], ...] = ()

    def add(self, *columns: NDArray[Any]) -> None:
        """Take the next rows of each column, (n, ...)."""
        numbers = np.arange(self.count, self.count + len(columns[0]))
        self.count += len(numbers)
        rows = self._selected((numbers, *columns))
        if self._rows:
            rows = tuple(np.concatenate(pair) for pair in zip(self._rows, rows, strict=True))
        while len(rows[0]) > self._most:
            self.step *= 2
            rows = self._selected(rows)
        self._rows = rows

    def _selected(self, rows: tuple[NDArray[Any], ...]) -> tuple[NDArray[Any], ...]:
        # 2^64 over the golden ratio; the product's low 64 bits are the fraction.
        with np.errstate(over="ignore"):
            fraction = rows[0].astype(np.uint64) * np.uint64(11400714819323198485)
        selected = fraction < np.uint64((1 << 64) // self.step - 1)
        return tuple(column[selected] for column in rows)

    @property
    def columns(self) -> tuple[NDArray[Any], ...]:
        """The selected rows of each column; none before the first rows."""
        return self._rows[1:]


@dataclass(frozen=True, slots=True)
class SampledFrame:
    """A logged frame, (height, width) or (I,), with the module's first output on it."""

    t: int
    frame: NDArray[Any]
    y: float


class ModuleOutputs:
    """A frozen module on the logged frames of its own stream, in memory that does not grow.

    Args:
        module: a frozen module with the frame shape of the run.
        spec: specification of the run's source.

    Attributes:
        count: frames that were taken.
    """

    def __init__(self, module: Module, spec: SourceSpec) -> None:
        self.module, self.count, self._shape = module, 0, spec.kind(module.stream_index)[0]
        self._sum, self._squares = np.zeros(prod(self._shape)), np.zeros(prod(self._shape))
        self._low: list[SampledFrame] = []
        self._high: list[SampledFrame] = []
        self._thinned = Subsample(MIDDLE_CANDIDATES)

    def take(self, batch: Batch) -> Iterator[tuple[IntArray, NDArray[Any], FloatArray]]:
        """Yield the stream's frames in a batch, and the outputs on them.

        Yields:
            (n,) t, (n, *frame_shape) and (n, J).

        Raises:
            UsageError: the module learned from other frames.
        """
        for t, frames in batch.watched if len(batch.blocks.starts) else ():
            places = batch.blocks.places(t)
            rows = np.flatnonzero(batch.blocks.streams[places] == self.module.stream_index)
            if len(rows):
                y = self.module.transform(frames[rows])
                self._add(places[rows], t[rows], frames[rows], y[:, 0])
                yield t[rows], frames[rows], y

    def _add(self, blocks: IntArray, t: IntArray, frames: NDArray[Any], y: FloatArray) -> None:
        self.count += len(t)
        for start in range(0, len(t), CHUNK):
            rows = frames[start : start + CHUNK].reshape(-1, self._sum.size).astype(np.float64)
            self._sum += rows.sum(axis=0)
            self._squares += np.einsum("ni,ni->i", rows, rows)
        self._thinned.add(t, frames, y)
        # At most one frame of a block: its neighbours look alike.
        starts = np.flatnonzero(np.diff(blocks, prepend=-1))
        parts = np.split(np.arange(len(t)), starts[1:])
        for picks, sign in ((self._low, 1), (self._high, -1)):
            rows = np.array([part[np.argmin(sign * y[part])] for part in parts])
            first = rows[np.unique(sign * y[rows], return_index=True)[1][:SAMPLE_FRAMES]]
            known = {pick.y for pick in picks}  # a log that is repeated has the same frames again
            picks += [
                SampledFrame(int(t[i]), frames[i].copy(), float(y[i]))
                for i in first
                if y[i] not in known
            ]
            picks.sort(key=lambda pick: sign * pick.y)
            del picks[SAMPLE_FRAMES:]

    @property
    def mean(self) -> FloatArray:
        """The mean frame, (*frame_shape)."""
        return (self._sum / max(self.count, 1)).reshape(self._shape)

    @property
    def deviation(self) -> FloatArray:
        """Standard deviation of each value over the frames, (*frame_shape)."""
        n = max(self.count, 1)
        variance = self._squares / n - (self._sum / n) ** 2
        return np.sqrt(np.maximum(variance, 0.0)).reshape(self._shape)

    def weights(self) -> FloatArray | None:
        """Return the weights of the first output, (*frame_shape); None for an expansion's."""
        phi = self.module.phi[0]
        return phi.reshape(self._shape) if phi.size == self._sum.size else None

    def saliency(self) -> FloatArray | None:
        """Return how far each value of a frame moves the first output, (*frame_shape).

        It is weight times deviation, in the unit of the output, whose variance was 1 where it was
        learned.
        """
        weights = self.weights()
        return None if weights is None else weights * self.deviation * self.module.scale

    def sheet(self) -> dict[str, list[SampledFrame]]:
        """Return frames of least, middle and greatest first output, none of them twice.

        The least are below the median, the greatest above it: a periodic stream has few blocks.
        """
        if not self.count:
            return {}
        used = {pick.t for pick in (*self._low, *self._high)}
        t, frames, y = self._thinned.columns
        median = float(np.median(y))
        nearest = np.argsort(np.abs(y - median), kind="stable")
        middle = [i for i in nearest.tolist() if int(t[i]) not in used][:SAMPLE_FRAMES]
        middle.sort(key=lambda i: (float(y[i]), int(t[i])))
        lows = [pick for pick in self._low if pick.y <= median]
        least = {pick.t for pick in lows}
        highs = [pick for pick in reversed(self._high) if pick.y >= median and pick.t not in least]
        return {
            "least": lows,
            "middle": [SampledFrame(int(t[i]), frames[i], float(y[i])) for i in middle],
            "greatest": highs,
        }
