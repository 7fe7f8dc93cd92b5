"""Decode the chunks of a log to tables of messages, and check everything that they state.

A chunk can state a wrong size and have any content: at most `MAX_CHUNK` bytes are allocated.
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

# Message indexes of a chunk: channel, and (n, 2) log time (ns) and offset of each message.
Pairs = list[tuple[int, NDArray[np.uint64]]]


@dataclass(frozen=True, slots=True)
class MessageTable:
    """Messages of one chunk in file order, one row for each.

    Attributes:
        data: (B,) uint8, the decompressed records of the chunk.
        records: (n,) of `cdmisfa.kernels.frames.MESSAGE`.
    """

    data: ByteArray
    records: NDArray[np.void]

    def __len__(self) -> int:
        return len(self.records)

    @property
    def channel(self) -> NDArray[np.uint16]:
        """(n,) channel of each message."""
        return self.records["channel"]

    @property
    def log_time(self) -> NDArray[np.uint64]:
        """(n,) log time of each message (ns)."""
        return self.records["log_time"]

    @property
    def at(self) -> IntArray:
        """(n,) offset of each payload in `data`."""
        return self.records["at"]

    @property
    def size(self) -> IntArray:
        """(n,) size of each payload (bytes)."""
        return self.records["size"]

    def select(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> MessageTable:
        """Return the messages at indices (k,), or where a mask (n,) is True."""
        # compress and take give the result of indexing in a third of its time.
        pick = self.records.compress if rows.dtype == np.bool_ else self.records.take
        return MessageTable(self.data, pick(rows))

    def rows(self) -> Iterator[tuple[int, int, int, int, bytes]]:
        """Return an iterator over channel, sequence, log time, publish time and payload."""
        # Lists of columns are faster than a list of rows; and slices of bytes than those of a view,
        # which for small messages saves more than the copy of the chunk takes.
        names = "channel", "sequence", "log_time", "publish_time"
        columns = [self.records[name].tolist() for name in names]
        spans = map(slice, self.at.tolist(), (self.at + self.size).tolist())
        payloads = map(bytes, map(self.data.data.__getitem__, spans))
        return zip(*columns, payloads, strict=True)

    def payload(self, row: int) -> bytes:
        """Return a copy of a message's payload."""
        return self.view(row).tobytes()

    def view(self, row: int) -> memoryview:
        """Return a message's payload as a view of the chunk's memory."""
        at = int(self.at[row])
        return self.data[at : at + int(self.size[row])].data

    def index(self, channel: int) -> bytes:
        """Return the message index record of a channel, in file order."""
        rows = self.channel == channel
        columns = self.log_time[rows], self.at[rows] - MESSAGE_HEADER.size
        pairs = np.stack(columns, 1, dtype="<u8", casting="unsafe")
        head = INDEX_HEADER.pack(Opcode.MESSAGE_INDEX, pairs.nbytes + 6, channel, pairs.nbytes)
        return head + pairs.tobytes()

    def agrees(self, indexes: Pairs) -> bool:
        """Return whether message indexes state exactly these messages."""
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
        data: (B,) the decompressed records.
        cut: True to ignore an invalid end.

    Raises:
        MalformedRecord: the chunk has bytes that are not a record, or a record of another section.
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
            raise MalformedRecord(f"it has a {Opcode(opcode).name} record, which is not allowed")
    if place < len(data) and not cut:
        raise MalformedRecord(f"no complete record begins at its byte {place}")
    return MessageTable(data, messages), definitions, times


# End of a warning about an index that contradicts its chunk, which does not lose messages.
UNUSED: Final = "(the index is not used)"

# Size of the decoded chunks in the cache, at least one chunk. It is small because reading moves
# forward, and because memory that is used again is still in the processor's cache.
CACHE_BYTES: Final = 1024 * 1024
# Largest window of zstd, which a hostile frame could otherwise set to any size.
_WINDOW: Final = MAX_CHUNK // 2
_PIECE: Final = 1 << 17
# A chunk is decoded ahead of time in another thread if it has at least this stored size (for less,
# the transfer takes longer than the decoding), at most this decompressed size (because of the
# memory), and at most this ratio of both (else there is little to decode).
_MIN_AHEAD: Final = 256 * 1024
_MAX_AHEAD: Final = 8 * 1024 * 1024
_MAX_RATIO: Final = 0.9


class _Zstd(threading.local):
    """One decompressor for each thread, because zstd's are not thread-safe."""

    def __init__(self) -> None:
        self.decompressor = zstandard.ZstdDecompressor(max_window_size=_WINDOW)


_ZSTD: Final = _Zstd()
_BROKEN: Final = (zstandard.ZstdError, RuntimeError, ValueError, MemoryError, EOFError)


class Chunks:
    """Decoder of the chunks of a file, with a cache of the last ones.

    Args:
        file: the log.
        definitions: receives the definitions in the chunks.
        note: called with (place, problem) for a message index that contradicts its chunk, which
            loses no message; None: do not compare indexes.
        without_crc: called for a chunk without a CRC.
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
        """Announce the chunks that will be read one after the other, to decode one ahead."""
        self._following = {first.offset: second for first, second in itertools.pairwise(segments)}

    def table(self, segment: Segment) -> MessageTable:
        """Return the messages of a chunk in file order.

        Raises:
            MalformedRecord: the chunk is damaged.
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
            MalformedRecord: the indexes are larger than any chunk.
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
        """Drop the decoded chunks, and end the thread; a second call does nothing."""
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
                raise MalformedRecord("it has messages outside its time range")
            if self._note and segment.indexes and not table.agrees(self.index(segment)):
                self._note(segment.name, f"its message index contradicts its messages {UNUSED}")
        for opcode, content in definitions:
            self._definitions.add(opcode, content, segment.name)
        return table

    def _look_ahead(self, segment: Segment) -> None:
        """Start to decode the next chunk in a thread, if decoding it takes long."""
        in_order = self._following.get(self._last) is segment
        self._last = segment.offset
        following = self._following.get(segment.offset)
        if following is None or not in_order or type(self._file) is not Store:
            return
        slow = _MIN_AHEAD <= following.stored < _MAX_RATIO * following.size
        if following.compression and slow and following.size <= _MAX_AHEAD and not following.cut:
            self._thread = self._thread or ThreadPoolExecutor(1)
            future = self._thread.submit(chunk_records, self._file, following)
            self._ahead = following.offset, future


def chunk_records(file: Store, segment: Segment) -> ByteArray:
    """Read the records of a chunk, and check its CRC; any thread may call this function.

    Args:
        file: the log.
        segment: the chunk; its CRC is set if only the summary stated the chunk.

    Raises:
        MalformedRecord: the chunk is damaged, or contradicts the summary.
    """
    compression, size, begin = segment.compression, segment.size, segment.offset
    check_size(compression, 0 if segment.cut else size)
    raw = np.frombuffer(file.read(begin, segment.data_end - begin), np.uint8)
    head, stored = raw.data[: segment.data_offset - begin], raw[segment.data_offset - begin :]
    if segment.stated:
        crc = int.from_bytes(head[CHUNK_HEADER.size - 4 : CHUNK_HEADER.size], "little")
        if head != segment.head(crc):
            raise MalformedRecord("it is not the chunk in the summary")
        segment.crc, segment.stated = crc, False
    records = decompressed(stored, compression, min(size, MAX_CHUNK), cut=segment.cut)
    if segment.cut:
        return records
    if segment.crc and crc32(records.data) != segment.crc:
        raise MalformedRecord("its CRC does not match")
    return freeze(records)


def check_size(compression: str, size: int) -> None:
    """Check that a compression is known, and a decompressed size is at most `MAX_CHUNK`."""
    if compression not in ("", "zstd", "lz4"):
        raise MalformedRecord(f"its compression {compression[:40]!r} is unknown")
    if size > MAX_CHUNK:
        raise MalformedRecord(
            f"it states a decompressed size of {size} bytes, above the limit of {MAX_CHUNK}"
        )


def decompressed(stored: ByteArray, compression: str, size: int, *, cut: bool = False) -> ByteArray:
    """Return the decompressed records of a chunk.

    Args:
        stored: the stored bytes.
        compression: "zstd", "lz4" or "".
        size: size that the chunk states, at most `MAX_CHUNK`.
        cut: True to return the records before the end of a cut chunk, at most `size` bytes.

    Raises:
        MalformedRecord: the data is damaged, or its size is not the stated one.
    """
    try:
        if compression == "zstd":
            records = _from_zstd(stored, size, cut)
        elif compression == "lz4":
            records = _from_lz4(stored, size, cut)
        else:
            records = stored[:size] if cut else stored
    except _BROKEN as error:
        raise MalformedRecord(f"its {compression} data is damaged ({error})") from None
    if len(records) != size and not cut:
        actual = f"more than {size}" if len(records) > size else len(records)
        raise MalformedRecord(f"it states {size} decompressed bytes and has {actual}")
    return records


def _from_zstd(stored: ByteArray, size: int, cut: bool) -> ByteArray:
    """Decompress zstd data, one byte more than `size` if there is more."""
    reader = _ZSTD.decompressor.stream_reader(stored.data, read_across_frames=True)
    out, done = np.empty(size + 1, np.uint8), 0
    step = _PIECE if cut else size  # in one step, zstd writes directly into `out`
    with contextlib.suppress(zstandard.ZstdError) if cut else contextlib.nullcontext():
        while done < size and (n := reader.readinto(out[done : min(done + step, size)].data)):
            done += n
        if done == size and not cut:
            done += reader.readinto(out[size:].data)
    return out[:done]


def _from_lz4(stored: ByteArray, size: int, cut: bool) -> ByteArray:
    """Decompress LZ4 data, one byte more than `size` if there is more."""
    lz4_frame = lz4.frame.LZ4FrameDecompressor()
    data = lz4_frame.decompress(stored.data, max_length=size + (not cut))
    if len(data) <= size and not (cut or lz4_frame.eof):
        raise ValueError("it is cut short")
    return np.frombuffer(data, np.uint8)
