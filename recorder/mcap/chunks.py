"""Decode the chunks of a log to tables of messages, and check all that they state.

A chunk may lie about its size and hold anything: no more memory is asked for than `MAX_CHUNK`.
"""

from __future__ import annotations

import contextlib
import itertools
import threading
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final

import lz4.frame
import numpy as np
import zstandard
from mcap.opcode import Opcode
from numpy.typing import NDArray

from cdmisfa.core.arrays import ByteArray, IntArray
from cdmisfa.core.blocks import freeze
from cdmisfa.core.errors import UsageError
from cdmisfa.kernels.frames import walk_records
from recorder.mcap.records import (
    CHUNK_HEADER,
    INDEX_HEADER,
    MAX_CHUNK,
    MESSAGE_HEADER,
    RECORD_HEADER,
    Definitions,
    MalformedRecord,
    Segment,
    crc32,
)
from recorder.mcap.store import Store

# The message indexes of a chunk: channel, and (n, 2) log time and place of each message.
Pairs = list[tuple[int, NDArray[np.uint64]]]


@dataclass(frozen=True, slots=True)
class MessageTable:
    """Messages of one chunk in file order, one row each.

    Attributes:
        data: (B,) uint8, the chunk's decompressed records.
        records: (n,) of `cdmisfa.kernels.frames.MESSAGE`.
    """

    data: ByteArray
    records: NDArray[np.void]

    def __len__(self) -> int:
        return len(self.records)

    @property
    def channel(self) -> NDArray[np.uint16]:
        """Channel of each message, (n,)."""
        return self.records["channel"]

    @property
    def log_time(self) -> NDArray[np.uint64]:
        """Log time of each message, (n,) nanoseconds."""
        return self.records["log_time"]

    @property
    def at(self) -> IntArray:
        """Place of each payload in `data`, (n,)."""
        return self.records["at"]

    @property
    def size(self) -> IntArray:
        """Bytes of each payload, (n,)."""
        return self.records["size"]

    def select(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> MessageTable:
        """Return the messages of rows, given by number, (k,), or by a truth value each, (n,)."""
        # The result of indexing, in a third of its time.
        pick = self.records.compress if rows.dtype == np.bool_ else self.records.take
        return MessageTable(self.data, pick(rows))

    def rows(self) -> Iterator[tuple[int, int, int, int, bytes]]:
        """Yield each message: channel, sequence, log time, publish time and payload."""
        data = self.data.data
        for log_time, published, at, size, sequence, channel, _ in self.records.tolist():
            yield channel, sequence, log_time, published, bytes(data[at : at + size])

    def payload(self, row: int) -> bytes:
        """Return a copy of a payload."""
        return self.view(row).tobytes()

    def view(self, row: int) -> memoryview:
        """Return a payload, still in the memory of the chunk."""
        at = int(self.at[row])
        return self.data[at : at + int(self.size[row])].data

    def index(self, channel: int) -> bytes:
        """Return the message index of a channel: time and place of each message, in file order."""
        rows = self.channel == channel
        columns = self.log_time[rows], self.at[rows] - MESSAGE_HEADER.size
        pairs = np.stack(columns, 1, dtype="<u8", casting="unsafe")
        head = INDEX_HEADER.pack(Opcode.MESSAGE_INDEX, pairs.nbytes + 6, channel, pairs.nbytes)
        return head + pairs.tobytes()

    def agrees(self, indexes: Pairs) -> bool:
        """Return whether message indexes name exactly these messages."""
        channels = np.repeat([n for n, _ in indexes], [len(pairs) for _, pairs in indexes])
        if len(channels) != len(self):
            return False
        pairs = np.concatenate([pairs for _, pairs in indexes])
        order = np.argsort(pairs[:, 1], kind="stable")
        pairs, places = pairs[order], self.at - MESSAGE_HEADER.size
        same = (pairs[:, 0] == self.log_time) & (pairs[:, 1] == places.view(np.uint64))
        return bool((same & (channels[order] == self.channel)).all())


def walked_table(
    data: ByteArray, *, cut: bool = False
) -> tuple[MessageTable, list[tuple[int, bytes]], tuple[int, int]]:
    """Return a chunk's messages, definitions as (opcode, content), and range of log times.

    Args:
        data: (B,) its decompressed records.
        cut: leave out its end where that is broken.

    Raises:
        MalformedRecord: it holds bytes that are no record, or a record that may not be there.
    """
    try:
        messages, others, place, times = walk_records(data)
    except UsageError as error:
        raise MalformedRecord(str(error)) from None
    definitions: list[tuple[int, bytes]] = []
    for at, end in others.tolist():
        opcode = int(data[at])
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            definitions.append((opcode, data[at + RECORD_HEADER.size : end].tobytes()))
        elif opcode <= max(Opcode) and not cut:
            raise MalformedRecord(f"it holds a {Opcode(opcode).name} record")
    if place < len(data) and not cut:
        raise MalformedRecord(f"its byte {place} begins no record that ends within it")
    return MessageTable(data, messages), definitions, times


# The end of a problem with an index that contradicts its chunk, which costs no message.
UNUSED: Final = "(the index is not used)"

# Decoded chunks that are kept, one at least: few, because reading moves forward, and memory that is
# used again is still in the CPU's cache.
CACHE_BYTES: Final = 1024 * 1024
# Most memory that zstd may take for its window, because a frame may ask for any.
_WINDOW: Final = MAX_CHUNK // 2
_PIECE: Final = 1 << 17
# A chunk is decoded ahead if it has this many stored bytes, as handing fewer over takes as long, at
# most this many decompressed, because of their memory, and is not hardly compressed.
_LONG: Final = 256 * 1024
_LARGE: Final = 8 * 1024 * 1024
_PACKED: Final = 0.9


class _Zstd(threading.local):
    """A decompressor for each thread."""

    def __init__(self) -> None:
        self.decompressor = zstandard.ZstdDecompressor(max_window_size=_WINDOW)


_ZSTD: Final = _Zstd()
_BROKEN: Final = (zstandard.ZstdError, RuntimeError, ValueError, MemoryError, EOFError)


class Chunks:
    """Decode the chunks of a file, and keep the last few.

    Args:
        file: the log.
        definitions: those of the chunks are added.
        note: called with (where, what) for a message index that is not of its chunk's messages,
            which costs none of them; None if indexes are not compared.
        without_crc: called for a chunk that has no CRC of its own.
    """

    def __init__(
        self,
        file: Store,
        definitions: Definitions,
        note: Callable[[str, str], None] | None,
        without_crc: Callable[[], None],
    ) -> None:
        self._file = file
        self._definitions = definitions
        self._note = note
        self._without_crc = without_crc
        self._cache: OrderedDict[int, MessageTable] = OrderedDict()
        self._cached = 0
        self._following: dict[int, Segment] = {}
        self._last = -1
        self._ahead: tuple[int, Future[ByteArray]] | None = None
        self._thread: ThreadPoolExecutor | None = None

    def expect(self, segments: Sequence[Segment]) -> None:
        """Announce the chunks that are read one after the other, to decode one ahead."""
        self._following = {one.offset: two for one, two in itertools.pairwise(segments)}

    def table(self, segment: Segment) -> MessageTable:
        """Return the messages of a chunk in file order.

        Raises:
            MalformedRecord: it is damaged.
        """
        key = segment.offset
        if key in self._cache:
            self._cache.move_to_end(key)
            return self._cache[key]
        while self._cache and self._cached + min(segment.size, MAX_CHUNK) > CACHE_BYTES:
            _, oldest = self._cache.popitem(last=False)
            self._cached -= len(oldest.data)
        self._cache[key] = table = self._decoded(segment)
        self._cached += len(table.data)
        return table

    def index(self, segment: Segment, channels: Collection[int] | None = None) -> Pairs:
        """Read a chunk's message indexes, or those of some channels.

        Raises:
            MalformedRecord: they are larger than any chunk.
        """
        if not segment.indexes:
            return []
        first, stop = segment.indexes[0].offset, segment.stop
        if stop - first > MAX_CHUNK:
            raise MalformedRecord("its message index is larger than any chunk")
        data, indexes = self._file.read(first, stop - first), []
        for part in segment.indexes:
            if channels is None or part.channel in channels:
                pairs = np.frombuffer(data, np.uint64, 2 * part.count, part.offset - first)
                indexes.append((part.channel, pairs.reshape(-1, 2)))
        return indexes

    def close(self) -> None:
        """Drop the decoded chunks, and end the thread; harmless when called twice."""
        self._cache.clear()
        self._cached, self._ahead = 0, None
        if self._thread is not None:
            self._thread.shutdown()

    def _decoded(self, segment: Segment) -> MessageTable:
        ahead, self._ahead = self._ahead, None
        self._look_ahead(segment)
        if ahead is not None and ahead[0] == segment.offset:
            raw = ahead[1].result()
        else:
            raw = chunk_records(self._file, segment)
        if not (segment.crc or segment.cut):
            self._without_crc()
        table, definitions, (earliest, latest) = walked_table(raw, cut=segment.cut)
        if len(table) and not segment.cut:
            if earliest < segment.start or latest > segment.end:
                raise MalformedRecord("it holds messages outside the time range it states")
            if self._note and segment.indexes and not table.agrees(self.index(segment)):
                self._note(segment.name, f"its message index is not of its messages {UNUSED}")
        for opcode, content in definitions:
            self._definitions.add(opcode, content, segment.name)
        return table

    def _look_ahead(self, segment: Segment) -> None:
        """Start to decode the next chunk while this one is used, if it takes long."""
        in_order = self._following.get(self._last) is segment
        self._last = segment.offset
        following = self._following.get(segment.offset)
        if following is None or not in_order or type(self._file) is not Store:
            return
        slow = following.compression and _LONG <= following.stored < _PACKED * following.size
        if slow and following.size <= _LARGE and not following.cut:
            self._thread = self._thread or ThreadPoolExecutor(1)
            future = self._thread.submit(chunk_records, self._file, following)
            self._ahead = following.offset, future


def chunk_records(file: Store, segment: Segment) -> ByteArray:
    """Read the records of a chunk, whose CRC must match; any thread may call it.

    Args:
        file: the log.
        segment: the chunk; its CRC is set where only the summary stated it.

    Raises:
        MalformedRecord: the chunk is damaged, or is not as the summary states it.
    """
    compression, size, begin = segment.compression, segment.size, segment.offset
    check_size(compression, 0 if segment.cut else size)
    raw = np.frombuffer(file.read(begin, segment.data_end - begin), np.uint8)
    head, stored = raw.data[: segment.data_offset - begin], raw[segment.data_offset - begin :]
    if segment.stated:
        crc = int.from_bytes(head[CHUNK_HEADER.size - 4 : CHUNK_HEADER.size], "little")
        if head != segment.head(crc):
            raise MalformedRecord("it is not the chunk that the summary names")
        segment.crc, segment.stated = crc, False
    records = decompressed(stored, compression, min(size, MAX_CHUNK), cut=segment.cut)
    if segment.cut:
        return records
    if segment.crc and crc32(records.data) != segment.crc:
        raise MalformedRecord("its CRC does not match: damaged")
    return freeze(records)


def check_size(compression: str, size: int) -> None:
    """Refuse an unknown compression, and more than `MAX_CHUNK` bytes decompressed."""
    if compression not in ("", "zstd", "lz4"):
        raise MalformedRecord(f"its compression {compression[:40]!r} is unknown")
    if size > MAX_CHUNK:
        raise MalformedRecord(
            f"it states {size} bytes decompressed, above the limit of {MAX_CHUNK} bytes"
        )


def decompressed(stored: ByteArray, compression: str, size: int, *, cut: bool = False) -> ByteArray:
    """Return the records of a chunk.

    Args:
        stored: its bytes.
        compression: "zstd", "lz4" or "".
        size: bytes that it states, at most `MAX_CHUNK`.
        cut: return the records before the end of a chunk that was cut, `size` bytes at most.

    Raises:
        MalformedRecord: broken data, or another number of bytes than stated.
    """
    try:
        if compression == "zstd":
            records = _from_zstd(stored, size, cut)
        elif compression == "lz4":
            records = _from_lz4(stored, size, cut)
        else:
            records = stored[:size] if cut else stored
    except _BROKEN as error:
        raise MalformedRecord(f"its {compression} data is broken ({error})") from None
    if len(records) != size and not cut:
        actual = f"more than {size}" if len(records) > size else len(records)
        raise MalformedRecord(f"it states {size} bytes decompressed and holds {actual}")
    return records


def _from_zstd(stored: ByteArray, size: int, cut: bool) -> ByteArray:
    """Decompress zstd, one byte more than `size` if there are more."""
    reader = _ZSTD.decompressor.stream_reader(stored.data, read_across_frames=True)
    out, done = np.empty(size + 1, np.uint8), 0
    step = _PIECE if cut else size  # where all of it fits, zstd writes straight into it
    with contextlib.suppress(zstandard.ZstdError) if cut else contextlib.nullcontext():
        while done < size and (n := reader.readinto(out[done : min(done + step, size)].data)):
            done += n
        if done == size and not cut:
            done += reader.readinto(out[size:].data)
    return out[:done]


def _from_lz4(stored: ByteArray, size: int, cut: bool) -> ByteArray:
    """Decompress LZ4, one byte more than `size` if there are more."""
    lz4_frame = lz4.frame.LZ4FrameDecompressor()
    data = lz4_frame.decompress(stored.data, max_length=size + (not cut))
    if len(data) <= size and not (cut or lz4_frame.eof):
        raise ValueError("it is cut short")
    return np.frombuffer(data, np.uint8)
