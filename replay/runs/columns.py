"""Records of consecutive iterations as arrays, without a Python object a record."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.signals import NO_STATE, SIGNALS, BlockSignals, Signal
from recorder.mcap.records import MalformedRecord
from replay.runs.messages import NUMBERS, alike, column, spans

Decode = Callable[[bytes], BlockSignals]


@dataclass(frozen=True, slots=True)
class SignalColumns:
    """Consecutive records of the same shapes: of each signal by its name the (n, *dims) values."""

    values: Mapping[str, NDArray[Any]]

    def __len__(self) -> int:
        return len(self.values["iteration"])

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self.values[name]

    @property
    def frames(self) -> NDArray[np.int64]:
        """(n,) first frame of each block."""
        return self.values["t"]

    @property
    def iterations(self) -> NDArray[np.int64]:
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

    def times(self, per_frame: bool = False) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Frames and iterations of the rows: one a record, or one a frame of it."""
        if not per_frame:
            return self.frames, self.iterations
        every = (self.frames[:, None] + np.arange(self.tau)).reshape(-1)
        return every, np.repeat(self.iterations, self.tau)


@dataclass(frozen=True, slots=True)
class Blocks:
    """Where the blocks of consecutive iterations began.

    Which iteration a frame is of cannot be computed from its number: between blocks may be gaps.

    Attributes:
        starts: (n,) first frame of each block.
        iterations: (n,) its iteration.
        streams: (n,) what was watched.
    """

    starts: NDArray[np.int64]
    iterations: NDArray[np.int64]
    streams: NDArray[np.int64]

    def places(self, frames: NDArray[np.int64]) -> NDArray[np.int64]:
        """Number, from 0, of the last block here that had begun at each frame, (n,) both."""
        return np.maximum(np.searchsorted(self.starts, frames, side="right") - 1, 0)

    def iteration(self, frames: NDArray[np.int64]) -> NDArray[np.int64]:
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
    def joined(cls, parts: Sequence[Blocks]) -> Blocks:
        """Several, one after the other."""
        none = np.empty(0, dtype=np.int64)
        every = ((p.starts, p.iterations, p.streams) for p in parts)
        return cls(*(np.concatenate(part) for part in zip((none,) * 3, *every, strict=True)))


def told(name: str, values: NDArray[Any]) -> bool:
    """Whether a signal's values are not all missing."""
    if values.dtype.kind == "f":
        return not bool(np.isnan(values).all())
    return values.size > 0 and (SIGNALS[name].since == 1 or bool((values != NO_STATE).any()))


def joined(pieces: Iterable[SignalColumns], names: Sequence[str]) -> dict[str, NDArray[Any]]:
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
    for _, group in groupby(records, key=_shapes):
        records = list(group)
        values = ((s, [getattr(r, s.name) for r in records]) for s in SIGNALS.values())
        yield SignalColumns({s.name: np.array(found, dtype=s.dtype) for s, found in values})


def columns_of_messages(messages: Sequence[bytes], decode: Decode) -> Iterator[SignalColumns]:
    """The records in messages as arrays, bit for bit what `decode` makes of each."""
    for _, group in groupby(messages, key=len):
        same_size = list(group)
        whole = _at_once(same_size, decode(same_size[0]))
        if whole is not None:
            yield whole
        else:
            yield from columns_of_records([decode(message) for message in same_size])


def _at_once(messages: Sequence[bytes], first: BlockSignals) -> SignalColumns | None:
    """All messages as laid out like the first one, or None where they are not."""
    try:
        places = spans(messages[0])
    except MalformedRecord:
        return None
    stored = {name: places[NUMBERS[name]] for name in SIGNALS if NUMBERS[name] in places}
    rows = alike(messages, list(stored.values()))
    if rows is None:
        return None
    values: dict[str, NDArray[Any]] = {}
    for signal in SIGNALS.values():
        value = np.asarray(getattr(first, signal.name), dtype=signal.dtype)
        shape = (len(messages), *value.shape)
        if signal.name not in stored:  # an empty array, or one that this version has not got
            values[signal.name] = np.broadcast_to(value, shape)
            continue
        start, stop = stored[signal.name]
        if stop - start != value.nbytes:
            return None
        kind = np.dtype("u1" if signal.dtype == "bool" else signal.dtype).newbyteorder("<")
        found = column(rows, (start, stop), kind.str)
        if signal.dtype == "bool":
            if found.max(initial=0) > 1:
                return None
            found = found.astype(bool)
        values[signal.name] = found.reshape(shape)
    return SignalColumns(values)


def _concatenated(signal: Signal, parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
    if not parts:
        return np.empty((0,) * (1 + len(signal.dims)), dtype=signal.dtype)
    most = max(part.shape[1] for part in parts) if signal.dims else 0
    return np.concatenate([padded(signal, part, most) for part in parts])


def _shapes(signals: BlockSignals) -> tuple[tuple[int, ...], ...]:
    return tuple(np.shape(getattr(signals, s.name)) for s in SIGNALS.values() if s.dims)
