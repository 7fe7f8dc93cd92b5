"""The chunks of a log, decoded and checked: every checksum, length and time that they state."""

from __future__ import annotations

import bisect
import contextlib
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Final

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from cdmisfa.core.blocks import freeze
from recorder.mcap.checksum import crc32
from replay.mcap.compression import Decompressor, Memory, check_size
from replay.mcap.records import (
    INDEX_HEADER,
    MAX_CHUNK,
    RECORD_HEADER,
    Bytes,
    Fields,
    MalformedRecord,
)
from replay.mcap.segments import Definitions, Segment
from replay.mcap.tables import MessageTable, Spans, indexed_table, walked_table
from replay.storage.once import OnePass
from replay.storage.store import FileStore, Store

UNUSED: Final = "(the index is not used)"
"""How it ends what is said of an index that contradicts its chunk, which costs no message."""
CACHE_BYTES: Final = 1024 * 1024
"""Decoded chunks that are kept, unless told otherwise; one always is.

Few, because reading moves forward, and memory that is used again is still in the CPU's cache.
"""
AHEAD: Final = 2
"""Chunks that are decompressed ahead at once, each in a thread, while others are looked at."""
_LARGE: Final = 8 * 1024 * 1024
"""Bytes of a chunk that is not decompressed ahead, because of the memory that this takes."""


class Chunks:
    """Decodes the chunks of a file; the last few are kept.

    Args:
        file: the log.
        definitions: take in what the chunks define.
        note: told (where, what) of an index that contradicts its chunk, and is not used.
        cache_bytes: of decoded chunks that are kept.
        without_crc: called for a chunk that has no CRC of its own.
    """

    def __init__(
        self,
        file: Store,
        definitions: Definitions,
        note: Callable[[str, str], None],
        cache_bytes: int,
        without_crc: Callable[[], None],
    ) -> None:
        self._file = file
        self._without_crc = without_crc
        self._definitions = definitions
        self._note = note
        self._cache_bytes = cache_bytes
        self._cache: OrderedDict[int, MessageTable] = OrderedDict()
        self._cached = 0
        self._decompressor = Decompressor()
        self._memory = Memory()
        self._expected: Sequence[Segment] = ()
        self._next = -1
        self._ahead: dict[int, Future[Bytes]] = {}
        self._threads: ThreadPoolExecutor | None = None

    def table(self, segment: Segment) -> MessageTable:
        """The messages of a chunk in file order.

        Raises:
            MalformedRecord: it is damaged.
        """
        key = segment.offset
        if key in self._cache:
            self._cache.move_to_end(key)
            return self._cache[key]
        while self._cache and self._cached + min(segment.size, MAX_CHUNK) > self._cache_bytes:
            self._drop(next(iter(self._cache)))
        coming = self._ahead.pop(key, None)
        self._look_ahead(segment)
        self._cache[key] = table = self._decode(segment, coming)
        self._cached += len(table.data)
        return table

    def expect(self, segments: Sequence[Segment]) -> None:
        """Hear which chunks are asked for one after the other: the next are decoded meanwhile."""
        self._expected, self._next = segments, -1
        self._stop_ahead()

    def index(self, segment: Segment) -> list[tuple[int, NDArray[np.uint64]]]:
        """Read a chunk's message indexes: channel, and (n, 2) of log time and offset.

        Raises:
            MalformedRecord: they are larger than any chunk.
        """
        if not segment.indexes:
            return []
        first, last = segment.indexes[0].offset, segment.indexes[-1]
        size = last.offset + 16 * last.count - first
        if size > MAX_CHUNK:
            raise MalformedRecord("its message index is larger than any chunk")
        raw = self._file.read(first, size)
        pairs = np.frombuffer
        return [
            (p.channel, pairs(raw, "<u8", 2 * p.count, p.offset - first).reshape(-1, 2))
            for p in segment.indexes
        ]

    def unpack(self, segment: Segment, out: Bytes) -> memoryview:
        """Decompress the records of a chunk with message indexes into `out`, (segment.size,).

        Returns:
            The records of its message indexes.

        Raises:
            MalformedRecord: it is damaged, or larger than any chunk with its indexes.
        """
        first, stop = segment.indexes[0].offset - INDEX_HEADER, segment.stop
        if stop - first > MAX_CHUNK:
            raise MalformedRecord("its message index is larger than any chunk")
        self._unpack(segment, out, self._file)
        self._prove(segment)
        return memoryview(self._file.read(first, stop - first))

    @contextlib.contextmanager
    def passing(self) -> Iterator[OnePass]:
        """Read each byte of the file once, as far as chunks are asked for in its order."""
        self._stop_ahead()
        before = self._file
        self._file = store = OnePass(before)
        try:
            yield store
        finally:
            self._file = before

    def forget(self, but: Collection[int] = ()) -> None:
        """Let go of the chunks that were decoded, but those at some places of the file."""
        self._stop_ahead()
        for key in self._cache.keys() - set(but):
            self._drop(key)

    def close(self) -> None:
        """Let go of all; harmless when called twice."""
        self.forget()
        threads, self._threads = self._threads, None
        if threads is not None:
            threads.shutdown()

    def _drop(self, key: int) -> None:
        self._cached -= len(self._cache.pop(key).data)

    def _look_ahead(self, segment: Segment) -> None:
        """Begin to decode the chunks after one, if it is the second or later taken in order."""
        at, expected = self._next, self._expected
        if not 0 <= at < len(expected) or expected[at] is not segment:
            self._stop_ahead()
            self._next = bisect.bisect_left(expected, segment.offset, key=lambda s: s.offset) + 1
            return
        self._next = at + 1
        for one in expected[at + 1 : at + 1 + AHEAD] if isinstance(self._file, FileStore) else ():
            small = one.chunked and not one.cut and max(one.size, one.stored) <= _LARGE
            if small and one.offset not in self._cache and one.offset not in self._ahead:
                self._threads = self._threads or ThreadPoolExecutor(AHEAD)
                self._ahead[one.offset] = self._threads.submit(self._records, one, self._file)

    def _stop_ahead(self) -> None:
        for coming in self._ahead.values():
            coming.cancel()
        self._ahead.clear()

    def _prove(self, segment: Segment) -> None:
        if not segment.crc:
            self._without_crc()

    def _unpack(self, segment: Segment, out: Bytes, file: Store) -> None:
        """Decompress the records of a chunk into `out`, (segment.size,), and check their CRC."""
        if segment.stated:
            confirm(file, segment)
        as_is = not segment.compression and segment.stored == len(out)
        stored = out if as_is else self._memory.take(min(segment.stored, file.size))
        there = file.read_into(segment.data_offset, stored.data)
        if not as_is:
            self._decompressor.decompress(stored[:there].data, segment.compression, out)
        elif there < len(out):
            raise MalformedRecord(f"it states {len(out)} bytes and holds {there}")
        if segment.crc and crc32(out.data) != segment.crc:
            raise MalformedRecord("its CRC does not match: damaged")

    def _records(self, segment: Segment, file: Store) -> Bytes:
        """The records of a whole chunk, decompressed and checked; threads may call it."""
        check_size(segment.compression, segment.size)
        raw = self._memory.take(segment.size)
        self._unpack(segment, raw, file)
        return freeze(raw)

    def _decode(self, segment: Segment, coming: Future[Bytes] | None) -> MessageTable:
        if segment.cut:
            stored = self._file.read(segment.data_offset, segment.stored)
            size = min(segment.size, MAX_CHUNK)
            found = self._decompressor.prefix(stored, segment.compression, size)
            raw = np.frombuffer(found, np.uint8)
            table, definitions = walked_table(raw, cut=True)
        else:
            raw = coming.result() if coming else self._records(segment, self._file)
            self._prove(segment)
            table, definitions = self._table_of(segment, raw)
            times = table.log_time
            if len(times) and (times.min() < segment.start or times.max() > segment.end):
                raise MalformedRecord("it holds messages outside the time range it states")
        for opcode, start, stop in definitions:
            self._definitions.add(opcode, raw[start:stop].tobytes(), segment.name)
        return table

    def _table_of(self, segment: Segment, raw: Bytes) -> tuple[MessageTable, Spans]:
        if not segment.indexes:
            return walked_table(raw)
        try:
            return indexed_table(raw, self.index(segment))
        except MalformedRecord as error:
            found = walked_table(raw)
            self._note(segment.name, f"{error} {UNUSED}")
            return found


def confirm(file: Store, segment: Segment) -> None:
    """Compare a chunk, and its message indexes, with what the summary says of it.

    Raises:
        MalformedRecord: they differ.
    """
    head = file.read(segment.offset, segment.data_offset - segment.offset)
    opcode, length = RECORD_HEADER.unpack_from(head)
    if opcode != Opcode.CHUNK:
        raise MalformedRecord("the summary points to something that is no chunk")
    found = Segment.of_chunk(segment.offset, head[RECORD_HEADER.size :])
    found.indexes = segment.indexes
    end = found.data_offset + found.stored
    stated = replace(segment, crc=found.crc, stated=False)
    if segment.offset + RECORD_HEADER.size + length != end or found != stated:
        raise MalformedRecord("it is not the chunk that the summary names")
    for part in segment.indexes:
        raw = Fields(file.read(part.offset - INDEX_HEADER, INDEX_HEADER), "a message index")
        fields = [raw.integer(width) for width in (1, 8, 2, 4)]
        size = 16 * part.count
        if fields != [Opcode.MESSAGE_INDEX, size + 6, part.channel, size]:
            raise MalformedRecord("its message index is not the one that the summary names")
    segment.crc = found.crc
    segment.stated = False
