"""Records of consecutive iterations as arrays, without a Python object a record."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import IntArray
from cdmisfa.core.signals import NO_STATE, SIGNALS, BlockSignals, Signal


@dataclass(frozen=True, slots=True)
class SignalColumns:
    """Consecutive records of the same shapes: of each signal by its name the (n, *dims) values."""

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
        """The records [start, stop) of these."""
        return SignalColumns({name: value[start:stop] for name, value in self.values.items()})

    def records(self) -> Iterator[BlockSignals]:
        """The records one by one."""
        values = (self.values[name] for name in SIGNALS)
        yield from map(BlockSignals, *(v.tolist() if v.ndim == 1 else v for v in values))

    def times(self, per_frame: bool = False) -> tuple[IntArray, IntArray]:
        """Frames and iterations of the rows: one per record, or one per frame of it."""
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
        iterations: (n,) its iteration.
        streams: (n,) the stream that was watched.
    """

    starts: IntArray
    iterations: IntArray
    streams: IntArray

    def places(self, frames: IntArray) -> IntArray:
        """Index of the last block here that had begun at each frame, (n,) both."""
        return np.maximum(np.searchsorted(self.starts, frames, side="right") - 1, 0)

    def iteration(self, frames: IntArray) -> IntArray:
        """The last iteration that had begun at each frame, (n,) both; 0 before the first."""
        if not len(self.starts):
            return np.zeros(len(frames), dtype=np.int64)
        return self.iterations[self.places(frames)]

    def last(self) -> Blocks:
        """The last one of these."""
        return Blocks(self.starts[-1:], self.iterations[-1:], self.streams[-1:])

    @classmethod
    def of(cls, columns: SignalColumns) -> Blocks:
        """Those of records, as copies: the records need not be kept for them."""
        kept = (columns.frames, columns.iterations, columns["stream"])
        return cls(*(np.array(part, dtype=np.int64) for part in kept))

    @classmethod
    def concatenated(cls, parts: Sequence[Blocks]) -> Blocks:
        """Several, one after the other."""
        none = np.empty(0, dtype=np.int64)
        every = ((p.starts, p.iterations, p.streams) for p in parts)
        return cls(*(np.concatenate(part) for part in zip((none,) * 3, *every, strict=True)))


def has_values(name: str, values: NDArray[Any]) -> bool:
    """Whether a signal's values are not all missing."""
    if values.dtype.kind == "f":
        return not bool(np.isnan(values).all())
    return values.size > 0 and (name != "state" or bool((values != NO_STATE).any()))


def whole_signals(pieces: Iterable[SignalColumns], names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Some signals of all records, (n, *dims) each; NaN for modules that were not there yet."""
    found: dict[str, list[NDArray[Any]]] = {name: [] for name in names}
    for piece in pieces:
        for name, parts in found.items():
            parts.append(piece[name])
    return {name: _concatenated(SIGNALS[name], found.pop(name)) for name in names}


def padded(signal: Signal, values: NDArray[Any], modules: int) -> NDArray[Any]:
    """(n, *dims) values with NaN for modules that were not there yet."""
    if not signal.dims.startswith("M") or values.shape[1] == modules:
        return values
    whole = np.full((len(values), modules, *values.shape[2:]), np.nan)
    whole[:, : values.shape[1]] = values
    return whole


def columns_of_records(records: Sequence[BlockSignals]) -> Iterator[SignalColumns]:
    """Records as arrays, a new piece wherever a shape changes."""
    for _, group in groupby(records, key=shapes_of):
        same = list(group)
        values = ((s, [getattr(r, s.name) for r in same]) for s in SIGNALS.values())
        yield SignalColumns({s.name: np.array(found, dtype=s.dtype) for s, found in values})


def shapes_of(signals: BlockSignals) -> tuple[tuple[int, ...], ...]:
    """The shape of each signal of a record that is an array, in the record's order."""
    return tuple([getattr(signals, name).shape for name in _ARRAYS])


def _concatenated(signal: Signal, parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
    if not parts:
        return np.empty((0,) * (1 + len(signal.dims)), dtype=signal.dtype)
    most = max(part.shape[1] for part in parts) if signal.dims else 0
    return np.concatenate([padded(signal, part, most) for part in parts])


_ARRAYS = tuple(s.name for s in SIGNALS.values() if s.dims)
