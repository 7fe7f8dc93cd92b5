"""The messages of chunks as columns: found by their message index or a walk, checked either way."""

from __future__ import annotations

import itertools
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from cdmisfa.core.arrays import ByteArray
from recorder.mcap.records import (
    MESSAGE_FIELDS,
    MESSAGE_HEADER,
    RECORD_HEADER,
    MalformedRecord,
    Segment,
    walk,
)

MAX_MESSAGES: Final = 1 << 20
"""Most messages of a chunk that are read; their table takes some 100 bytes of each."""

_NO_TIMES: Final = np.empty(0, np.uint64)

Spans = list[tuple[int, int, int]]
"""(opcode, start, stop) of the content of every definition in a chunk."""


@dataclass(frozen=True, slots=True)
class MessageTable:
    """The messages of one chunk in file order, one row each.

    Attributes:
        data: (B,) uint8, the chunk's decompressed records.
        headers: (n,) of `MESSAGE_HEADER`: channel, sequence and times in nanoseconds.
        at: (n,) int64, place of the payload in `data`.
        size: (n,) int64, bytes of the payload.
    """

    data: ByteArray
    headers: NDArray[np.void]
    at: NDArray[np.int64]
    size: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.at)

    @property
    def channel(self) -> NDArray[np.uint16]:
        """Channel of each message, (n,)."""
        return self.headers["channel"]

    @property
    def log_time(self) -> NDArray[np.uint64]:
        """Log time of each message, (n,) nanoseconds."""
        return self.headers["log_time"]

    def select(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> MessageTable:
        """The messages of some rows, given by number, (k,), or by a truth value each, (n,)."""
        return MessageTable(self.data, self.headers[rows], self.at[rows], self.size[rows])

    def rows(self) -> Iterator[tuple[int, int, int, int, bytes]]:
        """Each message: channel, sequence, log time, publish time and payload."""
        heads, data = self.headers, self.data.data
        fields = ("channel", "sequence", "log_time", "publish_time")
        columns = [heads[name].tolist() for name in fields]
        places = self.at.tolist(), (self.at + self.size).tolist()
        for channel, sequence, log_time, published, at, stop in zip(*columns, *places, strict=True):
            yield channel, sequence, log_time, published, bytes(data[at:stop])

    def by_time(self) -> MessageTable:
        """The messages by log time, ties as they are."""
        times = self.log_time
        if (times[1:] >= times[:-1]).all():
            return self
        return self.select(np.argsort(times, kind="stable"))

    def payload(self, row: int) -> bytes:
        """A copy of a payload."""
        return self.view(row).tobytes()

    def view(self, row: int) -> memoryview:
        """A payload where it lies in the chunk."""
        at = int(self.at[row])
        return self.data[at : at + int(self.size[row])].data


def table_at(data: ByteArray, offsets: NDArray[np.int64]) -> MessageTable:
    """Build the table of the message records that begin at places of a chunk, and check them.

    Args:
        data: the chunk's records.
        offsets: (n,) places in `data`.

    Raises:
        MalformedRecord: at one is no message, or one that does not lie within the chunk.
    """
    _check_count(len(offsets))
    if len(offsets) == 0:
        return MessageTable(data, np.empty(0, MESSAGE_HEADER), offsets, offsets)
    width = MESSAGE_HEADER.itemsize
    if offsets.min() < 0 or offsets.max() + width > len(data):
        raise MalformedRecord("a message lies outside its chunk")
    windows = np.ndarray((len(data) - width + 1, width), np.uint8, data, 0, (1, 1))
    headers = windows[offsets].view(MESSAGE_HEADER)[:, 0]
    if (headers["opcode"] != Opcode.MESSAGE).any():
        raise MalformedRecord("a message index points to something else than a message")
    length = headers["length"]
    if length.min() < MESSAGE_FIELDS:
        raise MalformedRecord("a message is shorter than its own header")
    size = length.astype(np.int64) - MESSAGE_FIELDS
    at = offsets + width
    if length.max() > len(data) or (at + size).max() > len(data):
        raise MalformedRecord("a message runs over the end of its chunk")
    return MessageTable(data, headers, at, size)


def _check_count(messages: int) -> None:
    if messages > MAX_MESSAGES:
        raise MalformedRecord(f"it holds more than {MAX_MESSAGES} messages, the limit of a chunk")


def walked_table(raw: ByteArray, *, cut: bool = False) -> tuple[MessageTable, Spans]:
    """Build the table of a chunk by walking over its records, without the broken end of a cut one.

    Raises:
        MalformedRecord: the chunk holds something that is no record, or that has no place there.
    """
    offsets = array("q")
    definitions: Spans = []
    try:
        for opcode, at, end in walk(raw.data, 0, len(raw)):
            if opcode == Opcode.MESSAGE:
                if end - at < MESSAGE_HEADER.itemsize:
                    raise MalformedRecord("a message is shorter than its own header")
                _check_count(len(offsets))
                offsets.append(at)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                definitions.append((opcode, at + RECORD_HEADER.size, end))
            elif opcode <= max(Opcode):
                raise MalformedRecord(f"it holds a {Opcode(opcode).name} record")
    except MalformedRecord:
        if not cut:
            raise
    return table_at(raw, np.array(offsets, np.int64)), definitions


def indexed_table(
    data: ByteArray, indexes: list[tuple[int, NDArray[np.uint64]]]
) -> tuple[MessageTable, Spans]:
    """Build the table of a chunk from its message indexes, without touching each message.

    The index is believed only where it accounts for every byte of the chunk: what lies
    between the messages it names is walked over.

    Raises:
        MalformedRecord: index and chunk contradict each other.
    """
    pairs = np.concatenate([pairs for _, pairs in indexes])
    numbers = np.array([number for number, _ in indexes], np.uint16)
    channels = np.repeat(numbers, [len(pairs) for _, pairs in indexes])
    if len(pairs) and pairs[:, 1].max() >= len(data):
        raise MalformedRecord("a message index points outside its chunk")
    offsets = pairs[:, 1].astype(np.int64)
    if (offsets[1:] <= offsets[:-1]).any():
        order = np.argsort(offsets, kind="stable")
        offsets, pairs, channels = offsets[order], pairs[order], channels[order]
    table = table_at(data, offsets)
    if (table.channel != channels).any() or (table.log_time != pairs[:, 0]).any():
        raise MalformedRecord("its message index names other messages than it holds")
    edges = np.empty((len(offsets) + 1, 2), np.int64)
    edges[1:, 0], edges[0, 0] = table.at + table.size, 0
    edges[:-1, 1], edges[-1, 1] = offsets, len(data)
    definitions: Spans = []
    for low, high in edges[edges[:, 0] != edges[:, 1]].tolist():
        if low > high:
            raise MalformedRecord("its message index names overlapping messages")
        for opcode, at, end in walk(data.data, low, high):
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                definitions.append((opcode, at + RECORD_HEADER.size, end))
            elif opcode <= max(Opcode):
                raise MalformedRecord("its message index leaves messages out")
    return table, definitions


def within(table: MessageTable, low: int, high: int) -> MessageTable:
    """The messages with log times in [low, high)."""
    times = table.log_time
    if not len(times) or (low <= int(times.min()) and int(times.max()) < high):
        return table
    keep = times >= np.uint64(min(low, 2**64 - 1))
    if high < 2**64:
        keep &= times < np.uint64(max(high, 0))
    return table.select(keep)


def in_order(
    segments: list[tuple[int, Segment]], table_of: Callable[[Segment], MessageTable | None]
) -> Iterator[tuple[Segment, MessageTable]]:
    """The messages of chunks by log time, ties in file order; overlapping chunks come in pieces.

    Args:
        segments: chunks with their place among those of the file.
        table_of: decodes a chunk; None where it is left out. Few are asked for at once.
    """
    for group in _overlapping(segments):
        if len(group) == 1:
            (segment,) = group
            alone = table_of(segment)
            if alone is not None and len(alone):
                yield segment, alone.by_time()
            continue
        times = [t.log_time if (t := table_of(s)) is not None else _NO_TIMES for s in group]
        order = np.argsort(np.concatenate(times), kind="stable")
        counts = [len(each) for each in times]
        chunk_of = np.repeat(np.arange(len(group)), counts)[order]
        row_of = np.concatenate([np.arange(count) for count in counts])[order]
        edges = [0, *(np.flatnonzero(np.diff(chunk_of)) + 1).tolist(), len(order)]
        for low, high in itertools.pairwise(edges if len(order) else ()):
            segment = group[int(chunk_of[low])]
            table = table_of(segment)
            if table is not None:
                yield segment, table.select(row_of[low:high])


def _overlapping(segments: list[tuple[int, Segment]]) -> Iterator[list[Segment]]:
    """Group segments so that sorting within each group sorts all."""
    ordered = sorted(segments, key=lambda pair: (pair[1].start, pair[0]))
    group: dict[int, Segment] = {}
    end, last = -1, -1
    for number, segment in ordered:
        if group and (segment.start > end or (segment.start == end and number > last)):
            yield [group[place] for place in sorted(group)]
            group, end, last = {}, -1, -1
        group[number] = segment
        end, last = max(end, segment.end), max(last, number)
    if group:
        yield [group[place] for place in sorted(group)]
