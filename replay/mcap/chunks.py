"""The chunks of a log, decoded and checked: every checksum, length and time that they state."""

from __future__ import annotations

import contextlib
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from typing import Final

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from cdmisfa.core.blocks import freeze
from recorder.mcap.checksum import crc32
from replay.mcap.compression import Decompressor, check_size
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
from replay.storage.store import Store

UNUSED: Final = "(the index is not used)"
"""How it ends what is said of an index that contradicts its chunk, which costs no message."""
CACHE_BYTES: Final = 32 * 1024 * 1024
"""Decoded chunks that are kept, unless told otherwise; one always is."""


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
        cache_bytes: int | None,
        without_crc: Callable[[], None],
    ) -> None:
        self._file = file
        self._without_crc = without_crc
        self._definitions = definitions
        self._note = note
        self._cache_bytes = CACHE_BYTES if cache_bytes is None else cache_bytes
        self._cache: OrderedDict[int, MessageTable] = OrderedDict()
        self._cached = 0
        self._decompressor = Decompressor()

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
        self._cache[key] = table = self._decode(segment)
        self._cached += len(table.data)
        return table

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
        stop = segment.stop
        if stop - segment.data_offset > 2 * MAX_CHUNK:
            raise MalformedRecord("its message index is larger than any chunk")
        raw = self._unpack(segment, stop, out)
        return raw[segment.indexes[0].offset - INDEX_HEADER - segment.data_offset :]

    @contextlib.contextmanager
    def passing(self) -> Iterator[OnePass]:
        """Read each byte of the file once, as far as chunks are asked for in its order."""
        before = self._file
        self._file = store = OnePass(before)
        try:
            yield store
        finally:
            self._file = before

    def forget(self, but: Collection[int] = ()) -> None:
        """Let go of the chunks that were decoded, but those at some places of the file."""
        for key in self._cache.keys() - set(but):
            self._drop(key)

    def _drop(self, key: int) -> None:
        self._cached -= len(self._cache.pop(key).data)

    def _unpack(self, segment: Segment, stop: int, out: Bytes) -> memoryview:
        """As `unpack`, with the bytes of the file from the chunk's records up to `stop`."""
        if segment.stated:
            confirm(self._file, segment)
        raw = memoryview(self._file.read(segment.data_offset, stop - segment.data_offset))
        self._decompressor.decompress(raw[: segment.stored], segment.compression, out)
        if not segment.crc:
            self._without_crc()
        elif crc32(out.data) != segment.crc:
            raise MalformedRecord("its CRC does not match: damaged")
        return raw

    def _decode(self, segment: Segment) -> MessageTable:
        if segment.cut:
            stored = self._file.read(segment.data_offset, segment.stored)
            size = min(segment.size, MAX_CHUNK)
            found = self._decompressor.prefix(stored, segment.compression, size)
            raw = np.frombuffer(found, np.uint8)
            table, definitions = walked_table(raw, cut=True)
        else:
            check_size(segment.compression, segment.size)
            raw = np.empty(segment.size, np.uint8)
            self._unpack(segment, segment.data_offset + segment.stored, raw)
            table, definitions = self._table_of(segment, freeze(raw))
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
