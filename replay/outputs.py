"""What modules say of their own streams: outputs on every logged frame, also before the save.

Signals hold a module's outputs only from its save on, and a stream that was learned is seldom
watched again. Logged frames tell the rest: a frozen module gives its outputs on them anew.
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

# Frames of a contact sheet with the least output, and of those with the greatest.
EACH = 5

# Frames from which those of middle output are picked.
KEPT = 64


class Thinned:
    """Rows spread evenly over all that come, at most `most`, with no period of their own.

    Every second or third row of something periodic would show one phase of it alone; so row i is
    kept where the fraction of i times the golden ratio is small. Which rows are kept depends
    neither on chance nor on how they come.

    Args:
        most: rows; when there are more, half of them go.

    Attributes:
        count: rows that came.
        step: how many of them one that is kept stands for.

    Example:
        >>> rows = Thinned(4)
        >>> for start in range(0, 10, 5):
        ...     rows.add(np.arange(start, start + 5))
        >>> rows.columns[0].tolist(), rows.step
        ([0, 2, 5], 4)
    """

    def __init__(self, most: int) -> None:
        self.step, self.count = 1, 0
        self._most = most
        self._at: IntArray = np.zeros(0, np.int64)
        self._columns: tuple[NDArray[Any], ...] = ()

    def add(self, *columns: NDArray[Any]) -> None:
        """Take the next rows of each column, (n, ...)."""
        at = np.arange(self.count, self.count + len(columns[0]))
        self.count += len(at)
        kept = self._kept(at)
        if self._columns:
            pairs = zip(self._columns, columns, strict=True)
            self._columns = tuple(np.concatenate([old, new[kept]]) for old, new in pairs)
        else:
            self._columns = tuple(column[kept] for column in columns)
        self._at = np.concatenate([self._at, at[kept]])
        while len(self._at) > self._most:
            self.step *= 2
            kept = self._kept(self._at)
            self._at = self._at[kept]
            self._columns = tuple(column[kept] for column in self._columns)

    def _kept(self, at: IntArray) -> NDArray[np.bool_]:
        # 2^64 over the golden ratio; the product's low 64 bits are the fraction.
        with np.errstate(over="ignore"):
            fraction = at.astype(np.uint64) * np.uint64(11400714819323198485)
        return np.asarray(fraction < np.uint64((1 << 64) // self.step - 1))

    @property
    def columns(self) -> tuple[NDArray[Any], ...]:
        """What is kept of each column; none before the first rows."""
        return self._columns


@dataclass(frozen=True, slots=True)
class Pick:
    """A logged frame, (height, width) or (I,), with the module's first output on it."""

    t: int
    frame: NDArray[Any]
    y: float


@dataclass(frozen=True, slots=True)
class Sheet:
    """Frames of least, middle and greatest output, each in the order of their outputs."""

    least: tuple[Pick, ...]
    middle: tuple[Pick, ...]
    greatest: tuple[Pick, ...]


class OwnStream:
    """A frozen module on the logged frames of its own stream, batch after batch.

    What it keeps does not grow with the run.

    Args:
        module: frozen; its frames are those of the run.
        spec: of the run's source.

    Attributes:
        count: frames that were taken.
    """

    def __init__(self, module: Module, spec: SourceSpec) -> None:
        self.module, self.count = module, 0
        self._shape = spec.frame_shape
        size = prod(spec.frame_shape)
        self._sum, self._squares = np.zeros(size), np.zeros(size)
        self._low: list[Pick] = []
        self._high: list[Pick] = []
        self._some = Thinned(KEPT)

    def take(self, batch: Batch) -> Iterator[tuple[IntArray, NDArray[Any], FloatArray]]:
        """The stream's frames in a batch of signals and frames, and the outputs on them.

        Yields:
            (n,) t, (n, *frame_shape) and (n, J).

        Raises:
            UsageError: the module learned from other frames.
        """
        for t, frames in batch.watched if len(batch.blocks.starts) else ():
            places = batch.blocks.places(t)
            own = np.flatnonzero(batch.blocks.streams[places] == self.module.stream_index)
            if len(own):
                y = self.module.transform(frames[own])
                self._keep(places[own], t[own], frames[own], y[:, 0])
                yield t[own], frames[own], y

    def _keep(self, blocks: IntArray, t: IntArray, frames: NDArray[Any], y: FloatArray) -> None:
        self.count += len(t)
        for start in range(0, len(t), CHUNK):
            rows = frames[start : start + CHUNK].reshape(-1, self._sum.size).astype(np.float64)
            self._sum += rows.sum(axis=0)
            self._squares += np.einsum("ni,ni->i", rows, rows)
        self._some.add(t, frames, y)
        # At most one frame of a block: its neighbours look alike.
        starts = np.flatnonzero(np.diff(blocks, prepend=-1))
        parts = np.split(np.arange(len(t)), starts[1:])
        least = np.array([part[np.argmin(y[part])] for part in parts])
        most = np.array([part[np.argmax(y[part])] for part in parts])
        for kept, rows_of, sign in ((self._low, least, 1), (self._high, most, -1)):
            first = rows_of[np.unique(sign * y[rows_of], return_index=True)[1][:EACH]]
            known = {pick.y for pick in kept}  # a log that is repeated shows the same frames again
            kept += [
                Pick(int(t[i]), frames[i].copy(), float(y[i])) for i in first if y[i] not in known
            ]
            kept.sort(key=lambda pick: sign * pick.y)
            del kept[EACH:]

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

    def weights(self, output: int = 0) -> FloatArray | None:
        """Weights of an output, (*frame_shape); None where they are of an expansion."""
        phi = self.module.phi[output]
        return phi.reshape(self._shape) if phi.size == self._sum.size else None

    def saliency(self, output: int = 0) -> FloatArray | None:
        """What each value of a frame moves an output by: weight times deviation, (*frame_shape).

        The unit is that of the output, which has variance 1 where it was learned.
        """
        weights = self.weights(output)
        return None if weights is None else weights * self.deviation * self.module.scale

    def sheet(self) -> Sheet:
        """Frames of least, middle and greatest first output, none of them twice."""
        some = self._some.columns
        if not some:
            return Sheet((), (), ())
        ends = (*self._low, *reversed(self._high))
        seen = {pick.t for pick in ends}
        t, frames, y = some
        nearest = np.argsort(np.abs(y - np.median(y)), kind="stable")
        middle = [i for i in nearest.tolist() if int(t[i]) not in seen][:EACH]
        middle.sort(key=lambda i: (float(y[i]), int(t[i])))
        picks = tuple(Pick(int(t[i]), frames[i], float(y[i])) for i in middle)
        low = tuple(self._low)
        among = {pick.t for pick in low}
        high = tuple(pick for pick in reversed(self._high) if pick.t not in among)
        return Sheet(low, picks, high)
