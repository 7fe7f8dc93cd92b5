"""Repairing what a log states twice, where one of the two is damaged.

The head of a chunk also stands in the summary, and its message indexes follow from its messages.
The checksum over all data says whether that is all that was wrong.
"""

from __future__ import annotations

from bisect import bisect_right
from typing import Final

import numpy as np

from recorder.mcap.chunks import MessageTable, check_size, decompressed, walked_table
from recorder.mcap.records import (
    CHUNK_HEADER,
    MalformedRecord,
    Problem,
    Segment,
    crc32,
)
from recorder.mcap.store import Store
from recorder.mcap.walk import LogStructure

_MOST_CHANNELS: Final = 64
"""Message indexes of a chunk that are compared with one another."""
_ALIKE: Final = 0.5
"""Share of an index's bytes by which one is known to stand at a place."""
_MOST_BYTES: Final = 64 * 1024 * 1024
"""Most bytes that are repaired."""


class MendedStore(Store):
    """A log with some bytes replaced; `mended` lists what was wrong."""

    def __init__(self, store: Store) -> None:
        super().__init__(store.path, store.size)
        self.mended: list[Problem] = []
        self._store = store
        self._places: list[int] = []
        self._parts: list[bytes] = []
        self._bytes = 0

    def put(self, at: int, right: bytes, where: str, what: str) -> None:
        """Replace the bytes at a place, behind those of the last call, where they differ."""
        there = self._store.read(at, len(right))
        if self._places and at < self._places[-1] + len(self._parts[-1]):
            return
        if there == right or len(there) < len(right) or self._bytes + len(right) > _MOST_BYTES:
            return
        self._places.append(at)
        self._parts.append(right)
        self._bytes += len(right)
        self.mended.append(Problem(where, what))
        self._window = b""  # it may show the bytes that were there

    def read_at(self, offset: int, count: int) -> bytes:
        found = bytearray(self._store.read_at(offset, count))
        stop = offset + len(found)
        first = max(bisect_right(self._places, offset) - 1, 0)
        last = bisect_right(self._places, stop)
        for place, part in zip(self._places[first:last], self._parts[first:last], strict=True):
            low, high = max(place, offset), min(place + len(part), stop)
            if low < high:
                found[low - offset : high - offset] = part[low - place : high - place]
        return bytes(found)

    def close(self) -> None:
        self._store.close()


def mended(file: Store) -> MendedStore:
    """A damaged log with the headers and message indexes of its chunks repaired."""
    store = MendedStore(file)
    structure = LogStructure(file, lambda *_: None, resync=True)
    stated = structure.summary.sound_chunks() if structure.summary else []
    chunks = stated or [segment for segment in structure.segments if segment.chunked]
    ends = [chunk.offset for chunk in chunks[1:]] + [structure.data_end or file.size]
    for chunk, end in zip(chunks, ends, strict=False):
        try:
            crc = _mend_head(store, chunk) if chunk.stated else chunk.crc
            table = _checked_table(store, chunk, crc)
        except MalformedRecord:
            continue
        at = chunk.data_offset + chunk.stored
        put = "its message index was damaged, and is made again from its messages"
        store.put(at, _indexes(store, at, end, table, chunk.stated), chunk.name, put)
    return store


def _mend_head(store: MendedStore, chunk: Segment) -> int:
    """Write a chunk's header as the summary states it; return its CRC, which only it states."""
    crc = int.from_bytes(store.read(chunk.offset + CHUNK_HEADER.size - 4, 4), "little")
    put = "its first bytes were damaged, and are made again from the summary"
    store.put(chunk.offset, chunk.head(crc), chunk.name, put)
    return crc


def _checked_table(store: Store, chunk: Segment, crc: int) -> MessageTable:
    """The messages of a chunk whose CRC matches."""
    check_size(chunk.compression, chunk.size)
    stored = np.frombuffer(store.read(chunk.data_offset, chunk.stored), np.uint8)
    raw = decompressed(stored, chunk.compression, chunk.size)
    if not crc or crc32(raw.data) != crc:
        raise MalformedRecord("no CRC that matches")
    return walked_table(raw)[0]


def _indexes(store: Store, at: int, end: int, table: MessageTable, stated: bool) -> bytes:
    """The message indexes of a chunk as they must stand in [at, end), none where it has none."""
    left = [table.index(number) for number in np.unique(table.channel).tolist()]
    if len(left) > _MOST_CHANNELS or sum(map(len, left)) > end - at:
        return b""
    found = b""
    while left:
        alike, place = max((_alike(store, at + len(found), x), -i) for i, x in enumerate(left))
        if alike < _ALIKE and not stated:
            return b""
        best = left.pop(-place)
        found += best
    return found


def _alike(store: Store, at: int, index: bytes) -> float:
    """The share of the bytes of an index that stand at a place."""
    there = np.frombuffer(store.read(at, len(index)), np.uint8)
    return float((there == np.frombuffer(index, np.uint8)[: len(there)]).mean())
