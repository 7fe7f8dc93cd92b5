"""The messages of a chunk as columns: found by its message index or a walk, checked either way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mcap.opcode import Opcode
from numpy.lib.stride_tricks import as_strided, sliding_window_view
from numpy.typing import NDArray

from replay.records import (
    MESSAGE_FIELDS,
    MESSAGE_HEADER,
    RECORD_HEADER,
    Bytes,
    MalformedRecord,
    walk,
)


@dataclass(frozen=True, slots=True)
class MessageTable:
    """The messages of one chunk in file order, one row each.

    Attributes:
        data: (B,) uint8, the chunk's decompressed records.
        channel: (n,) uint16.
        sequence: (n,) uint32.
        log_time: (n,) uint64, nanoseconds.
        publish_time: (n,) uint64, nanoseconds.
        at: (n,) int64, place of the payload in `data`.
        size: (n,) int64, bytes of the payload.
    """

    data: Bytes
    channel: NDArray[np.uint16]
    sequence: NDArray[np.uint32]
    log_time: NDArray[np.uint64]
    publish_time: NDArray[np.uint64]
    at: NDArray[np.int64]
    size: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.at)

    def select(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> MessageTable:
        """Give the table of some rows."""
        return MessageTable(
            self.data,
            self.channel[rows],
            self.sequence[rows],
            self.log_time[rows],
            self.publish_time[rows],
            self.at[rows],
            self.size[rows],
        )

    def payload(self, row: int) -> bytes:
        """Copy the payload of one message."""
        at = int(self.at[row])
        return self.data[at : at + int(self.size[row])].tobytes()

    def windows(self, at: NDArray[np.int64], size: int) -> Bytes:
        """Give `size` bytes from each of n places in `data` as an (n, size) array.

        Where the places are evenly spaced this is a view, otherwise a copy.

        Raises:
            MalformedRecord: a window lies outside the data.
        """
        if len(at) == 0 or size == 0:
            return np.empty((len(at), size), np.uint8)
        if at.min() < 0 or at.max() + size > len(self.data):
            raise MalformedRecord("a message is shorter than its fields")
        steps = np.diff(at)
        step = int(steps[0]) if len(steps) else size
        if step > 0 and (steps == step).all():
            return as_strided(self.data[int(at[0]) :], (len(at), size), (step, 1), writeable=False)
        return sliding_window_view(self.data, size)[at]


def table_at(data: Bytes, offsets: NDArray[np.int64]) -> MessageTable:
    """Build the table of the message records that begin at n places of a chunk.

    Raises:
        MalformedRecord: what stands there is no message, or runs over the chunk's end.
    """
    if len(offsets) == 0:
        headers = np.empty(0, MESSAGE_HEADER)
    else:
        width = MESSAGE_HEADER.itemsize
        if offsets.min() < 0 or offsets.max() + width > len(data):
            raise MalformedRecord("a message lies outside its chunk")
        headers = np.ascontiguousarray(sliding_window_view(data, width)[offsets])
        headers = headers.view(MESSAGE_HEADER)[:, 0]
    if (headers["opcode"] != Opcode.MESSAGE).any():
        raise MalformedRecord("a message index points to something else than a message")
    length = headers["length"]
    if (length < MESSAGE_FIELDS).any():
        raise MalformedRecord("a message is shorter than its own header")
    room = (len(data) - RECORD_HEADER.size - offsets).astype(np.uint64)
    if (length > room).any():
        raise MalformedRecord("a message runs over the end of its chunk")
    return MessageTable(
        data,
        headers["channel"].copy(),
        headers["sequence"].copy(),
        headers["log_time"].copy(),
        headers["publish_time"].copy(),
        offsets + MESSAGE_HEADER.itemsize,
        length.astype(np.int64) - MESSAGE_FIELDS,
    )


def walked_table(
    raw: bytes, *, cut: bool = False
) -> tuple[MessageTable, list[tuple[int, int, int]]]:
    """Build the table of a chunk by walking over its records.

    Args:
        raw: the chunk's records.
        cut: the chunk ends early; what is broken at its end is left out.

    Returns:
        The table, and (opcode, start, stop) of the content of every definition.

    Raises:
        MalformedRecord: the chunk holds something that is no record, or that has no place there.
    """
    offsets: list[int] = []
    definitions: list[tuple[int, int, int]] = []
    try:
        for opcode, at, end in walk(raw):
            if opcode == Opcode.MESSAGE:
                if end - at < MESSAGE_HEADER.itemsize:
                    raise MalformedRecord("a message is shorter than its own header")
                offsets.append(at)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                definitions.append((opcode, at + RECORD_HEADER.size, end))
            elif opcode <= max(Opcode):
                raise MalformedRecord(f"it holds a {Opcode(opcode).name} record")
    except MalformedRecord:
        if not cut:
            raise
    return table_at(np.frombuffer(raw, np.uint8), np.array(offsets, np.int64)), definitions


def indexed_table(
    raw: bytes, indexes: list[tuple[int, NDArray[np.uint64]]]
) -> tuple[MessageTable, list[tuple[int, int, int]]]:
    """Build the table of a chunk from its message indexes, without touching each message.

    The index is believed only where it accounts for every byte of the chunk: what lies
    between the messages it names is walked over.

    Raises:
        MalformedRecord: index and chunk contradict each other.
    """
    data = np.frombuffer(raw, np.uint8)
    pairs = np.concatenate([pairs for _, pairs in indexes])
    channels = np.concatenate([np.full(len(p), c, np.uint16) for c, p in indexes])
    if len(pairs) and pairs[:, 1].max() >= len(data):
        raise MalformedRecord("a message index points outside its chunk")
    offsets = pairs[:, 1].astype(np.int64)
    if (np.diff(offsets) <= 0).any():
        order = np.argsort(offsets, kind="stable")
        offsets, pairs, channels = offsets[order], pairs[order], channels[order]
    table = table_at(data, offsets)
    if (table.channel != channels).any() or (table.log_time != pairs[:, 0]).any():
        raise MalformedRecord("its message index names other messages than it holds")
    starts = np.append(offsets, len(data))
    ends = np.concatenate([[0], table.at + table.size])
    definitions: list[tuple[int, int, int]] = []
    for gap in np.flatnonzero(starts != ends):
        if starts[gap] < ends[gap]:
            raise MalformedRecord("its message index names overlapping messages")
        for opcode, at, end in walk(raw, int(ends[gap]), int(starts[gap])):
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                definitions.append((opcode, at + RECORD_HEADER.size, end))
            elif opcode <= max(Opcode):
                raise MalformedRecord("its message index leaves messages out")
    return table, definitions
