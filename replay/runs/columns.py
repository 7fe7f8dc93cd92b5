"""Records of consecutive iterations as arrays, without a Python object a record."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import IntArray
from cdmisfa.core.signals import NO_STATE, SIGNALS, BlockSignals, Signal


@dataclass(frozen=True, slots=True)
class SignalColumns:
    """Consecutive records of the same shapes: (n, *dims) values of each signal by its name."""

    values: Mapping[str, NDArray[Any]]

    def __len__(self) -> int:
        return len(self.values["iteration"])

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self.values[name]

    @property
    def frames(self) -> IntArray:
        """(n,) first frame of each block."""
        return self.values["t"]

    @property
    def iterations(self) -> IntArray:
        """(n,) iterations."""
        return self.values["iteration"]

    @property
    def tau(self) -> int:
        """Frames of a block."""
        return int(self.values["y"].shape[1])

    def rows(self, start: int, stop: int) -> SignalColumns:
        """Return the records [start, stop)."""
        return SignalColumns({name: value[start:stop] for name, value in self.values.items()})

    def records(self) -> Iterator[BlockSignals]:
        """Yield the records one by one."""
        values = (self.values[name] for name in SIGNALS)
        yield from map(BlockSignals, *(v.tolist() if v.ndim == 1 else v for v in values))

    def times(self, per_frame: bool = False) -> tuple[IntArray, IntArray]:
        """Return frames and iterations of the rows: one per record, or one per frame of it."""
        if not per_frame:
            return self.frames, self.iterations
        every = (self.frames[:, None] + np.arange(self.tau)).reshape(-1)
        return every, np.repeat(self.iterations, self.tau)


@dataclass(frozen=True, slots=True)
class Blocks:
    """First frames, iterations and streams of consecutive blocks.

    The iteration of a frame cannot be computed from its number: there may be gaps between blocks.

    Attributes:
        starts: (n,) first frame of each block.
        iterations: (n,) iteration of each block.
        streams: (n,) attended stream.
    """

    starts: IntArray
    iterations: IntArray
    streams: IntArray

    def places(self, frames: IntArray) -> IntArray:
        """Return the index of the last block that began at or before each frame, (n,) both."""
        return np.maximum(np.searchsorted(self.starts, frames, side="right") - 1, 0)

    def iteration(self, frames: IntArray) -> IntArray:
        """Return the last iteration that began at or before each frame; 0 before the first."""
        if not len(self.starts):
            return np.zeros(len(frames), dtype=np.int64)
        return self.iterations[self.places(frames)]

    def last(self) -> Blocks:
        """Return the last block."""
        return Blocks(self.starts[-1:], self.iterations[-1:], self.streams[-1:])

    @classmethod
    def of(cls, columns: SignalColumns) -> Blocks:
        """Return copies of the blocks of records, which can then be freed."""
        parts = (columns.frames, columns.iterations, columns["stream"])
        return cls(*(np.array(part, dtype=np.int64) for part in parts))

    @classmethod
    def concatenated(cls, parts: Sequence[Blocks]) -> Blocks:
        """Return the blocks of several parts, in order."""
        empty = np.empty(0, dtype=np.int64)
        names = ("starts", "iterations", "streams")
        return cls(*(np.concatenate([empty, *(getattr(p, n) for p in parts)]) for n in names))


def has_values(name: str, values: NDArray[Any]) -> bool:
    """Return whether any of a signal's values is present."""
    if values.dtype.kind == "f":
        return not bool(np.isnan(values).all())
    return values.size > 0 and (name != "state" or bool((values != NO_STATE).any()))


def whole_signals(pieces: Iterable[SignalColumns], names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Return some signals of all records, (n, *dims) each; NaN for modules not yet learned."""
    parts: dict[str, list[NDArray[Any]]] = {name: [] for name in names}
    for piece in pieces:
        for name in names:
            parts[name].append(piece[name])
    return {name: _concatenated(SIGNALS[name], parts.pop(name)) for name in names}


def padded(signal: Signal, values: NDArray[Any], modules: int) -> NDArray[Any]:
    """Return (n, *dims) values, padded with NaN for modules not yet learned."""
    if not signal.dims.startswith("M") or values.shape[1] == modules:
        return values
    whole = np.full((len(values), modules, *values.shape[2:]), np.nan)
    whole[:, : values.shape[1]] = values
    return whole


def columns_of_records(records: Sequence[BlockSignals]) -> Iterator[SignalColumns]:
    """Yield records as arrays, a new piece wherever a shape changes."""
    arrays = attrgetter(*(s.name for s in SIGNALS.values() if s.dims))
    for _, group in groupby(records, key=lambda r: [array.shape for array in arrays(r)]):
        same = list(group)
        yield SignalColumns(
            {
                name: np.array([getattr(r, name) for r in same], s.dtype)
                for name, s in SIGNALS.items()
            }
        )


def _concatenated(signal: Signal, parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
    if not parts:
        return np.empty((0,) * (1 + len(signal.dims)), dtype=signal.dtype)
    most = max(part.shape[1] for part in parts) if signal.dims else 0
    return np.concatenate([padded(signal, part, most) for part in parts])
