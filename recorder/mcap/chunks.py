"""The chunks of a log, decoded and checked: every checksum, length and time that they state."""

from __future__ import annotations

import bisect
import contextlib
import struct
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Final

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from cdmisfa.core.arrays import ByteArray
from cdmisfa.core.blocks import freeze
from recorder.mcap.compression import Decompressor, Memory, check_size
from recorder.mcap.records import (
    INDEX_HEADER,
    MAX_CHUNK,
    RECORD_HEADER,
    Definitions,
    MalformedRecord,
    Segment,
    crc32,
)
from recorder.mcap.store import FileStore, OnePass, Store
from recorder.mcap.tables import MessageTable, Spans, indexed_table, walked_table

UNUSED: Final = "(the index is not used)"
"""How it ends what is said of an index that contradicts its chunk, which costs no message."""
CACHE_BYTES: Final = 1024 * 1024
"""Decoded chunks that are kept, unless told otherwise; one always is.

Few, because reading moves forward, and memory that is used again is still in the CPU's cache.
"""
AHEAD: Final = 2
"""Chunks that are decompressed ahead at once, each in a thread, while others are looked at."""
_PACKED: Final = 0.9
"""How small what is stored of a chunk is against its size where it is decompressed ahead."""
_LARGE: Final = 8 * 1024 * 1024
"""Bytes of a chunk that is not decompressed ahead, because of the memory that this takes."""


_HEAD: Final = struct.Struct("<BQQQQI")
"""Of a chunk: opcode, length, first and last log time, size and CRC of its records."""
_OF_CHUNK: Final = bytes([Opcode.CHUNK])
_INDEX_HEAD: Final = struct.Struct("<BQHI")
"""Of a message index: opcode, length, channel, bytes of the pairs."""

Unpacked = tuple[ByteArray, bytes]
"""The records of a chunk, and what of its message indexes follows it in the file."""


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
        self._ahead: dict[int, Future[Unpacked]] = {}
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
        return _pairs(segment, self._file.read(first, size), first)

    def unpack(self, segment: Segment, out: ByteArray) -> memoryview:
        """Decompress the records of a chunk with message indexes into `out`, (segment.size,).

        Returns:
            The records of its message indexes.

        Raises:
            MalformedRecord: it is damaged, or larger than any chunk with its indexes.
        """
        records, after = self._unpack(segment, self._file, out)
        if segment.stop > segment.data_end + len(after):
            raise MalformedRecord("its message index is larger than any chunk")
        if records is not out:
            out[:] = records
        self._prove(segment)
        return memoryview(after)[segment.indexes[0].offset - INDEX_HEADER - segment.data_end :]

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
            # What is hardly compressed is read in less time than another thread takes it over.
            packed = one.compression and not one.cut and one.stored < _PACKED * one.size
            known = one.offset in self._cache or one.offset in self._ahead
            if packed and not known and one.size <= _LARGE:
                self._threads = self._threads or ThreadPoolExecutor(AHEAD)
                self._ahead[one.offset] = self._threads.submit(self._records, one, self._file)

    def _stop_ahead(self) -> None:
        for coming in self._ahead.values():
            coming.cancel()
        self._ahead.clear()

    def _prove(self, segment: Segment) -> None:
        if not segment.crc:
            self._without_crc()

    def _unpack(self, segment: Segment, file: Store, out: ByteArray | None = None) -> Unpacked:
        """Read a chunk with its message indexes at once, decompress it and check its CRC.

        Args:
            segment: not cut.
            file: that holds it.
            out: (segment.size,), what is decompressed is written into; by default into memory
                that is kept.
        """
        check_size(segment.compression, segment.size)
        begin, ends = segment.offset, segment.data_end
        stop = segment.stop if segment.stop - ends <= MAX_CHUNK else ends
        raw = self._memory.take(max(min(stop, file.size) - begin, 0))
        raw = raw[: file.read_into(begin, raw.data)]
        if segment.stated:
            confirm(file, segment, raw.data)
        stored = raw[segment.data_offset - begin : ends - begin]
        if not segment.compression and segment.stored == segment.size:
            records = stored
            if len(records) < segment.size:
                raise MalformedRecord(f"it states {segment.size} bytes and holds {len(records)}")
        else:
            records = self._memory.take(segment.size) if out is None else out
            self._decompressor.decompress(stored.data, segment.compression, records)
        if segment.crc and crc32(records.data) != segment.crc:
            raise MalformedRecord("its CRC does not match: damaged")
        return records, raw[ends - begin :].tobytes()

    def _records(self, segment: Segment, file: Store) -> Unpacked:
        """The records of a whole chunk, checked, that nobody writes to; threads may call it."""
        records, after = self._unpack(segment, file)
        return freeze(records), after

    def _decode(self, segment: Segment, coming: Future[Unpacked] | None) -> MessageTable:
        if segment.cut:
            stored = self._file.read(segment.data_offset, segment.stored)
            size = min(segment.size, MAX_CHUNK)
            found = self._decompressor.prefix(stored, segment.compression, size)
            raw = np.frombuffer(found, np.uint8)
            table, definitions = walked_table(raw, cut=True)
        else:
            raw, after = coming.result() if coming else self._records(segment, self._file)
            self._prove(segment)
            table, definitions = self._table_of(segment, raw, after)
            times = table.log_time
            if len(times) and (times.min() < segment.start or times.max() > segment.end):
                raise MalformedRecord("it holds messages outside the time range it states")
        for opcode, start, stop in definitions:
            self._definitions.add(opcode, raw[start:stop].tobytes(), segment.name)
        return table

    def _table_of(
        self, segment: Segment, raw: ByteArray, after: bytes
    ) -> tuple[MessageTable, Spans]:
        if not segment.indexes:
            return walked_table(raw)
        try:
            if segment.stop > segment.data_end + len(after):
                raise MalformedRecord("its message index is larger than any chunk")
            return indexed_table(raw, _pairs(segment, after, segment.data_end))
        except MalformedRecord as error:
            found = walked_table(raw)
            self._note(segment.name, f"{error} {UNUSED}")
            return found


def _pairs(segment: Segment, data: bytes, at: int) -> list[tuple[int, NDArray[np.uint64]]]:
    """A chunk's message indexes, in the bytes of the file from a place on; see `Chunks.index`."""
    pairs = np.frombuffer
    return [
        (p.channel, pairs(data, "<u8", 2 * p.count, p.offset - at).reshape(-1, 2))
        for p in segment.indexes
    ]


def confirm(file: Store, segment: Segment, data: memoryview) -> None:
    """Compare a chunk, and its message indexes, with what the summary says of it.

    Args:
        file: that holds it.
        segment: what the summary says.
        data: the bytes of the file from its first on, if not all of them.

    Raises:
        MalformedRecord: they differ.
    """
    head = data[: segment.data_offset - segment.offset]
    if head[:1] != _OF_CHUNK:
        raise MalformedRecord("the summary points to something that is no chunk")
    name, length = segment.compression.encode(), segment.data_end - segment.offset
    crc = int.from_bytes(head[_HEAD.size - 4 : _HEAD.size], "little")
    times = segment.start, segment.end
    stated = _HEAD.pack(Opcode.CHUNK, length - RECORD_HEADER.size, *times, segment.size, crc)
    stated += len(name).to_bytes(4, "little") + name + segment.stored.to_bytes(8, "little")
    if head != stated:
        raise MalformedRecord("it is not the chunk that the summary names")
    for part in segment.indexes:
        at, size = part.offset - INDEX_HEADER, 16 * part.count
        found = data[at - segment.offset :][:INDEX_HEADER] or file.read(at, INDEX_HEADER)
        if found != _INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, size + 6, part.channel, size):
            raise MalformedRecord("its message index is not the one that the summary names")
    segment.crc = crc
    segment.stated = False
