"""The summary at a log's end: what it counts, and where it says that everything is.

It is believed only where it accounts for every message it counts, and only for logs of which
not every byte is read; every chunk is compared with it when it is read.
"""

from __future__ import annotations

import contextlib
import itertools
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from cdmisfa.core.arrays import ByteArray
from recorder.mcap.records import (
    INDEX_HEADER,
    MAGIC,
    MAX_CHUNK,
    MAX_DEFINITION,
    RECORD_HEADER,
    Definitions,
    Fields,
    IndexPart,
    MalformedRecord,
    Refuse,
    Segment,
    Statistics,
    statistics,
)
from recorder.mcap.store import Excerpt, Store

_FIXED = RECORD_HEADER.size + 40
"""Bytes of a chunk before its records, without the name of its compression."""
_CHUNK: Final = struct.Struct("<QQQQI")
"""Log times of a chunk's first and last message, its place and length, bytes of the next."""
_PLACE: Final = struct.Struct("<HQ")
"""A channel, and where its message index is."""
_SIZES: Final = struct.Struct("<QQ")
"""Bytes of a chunk's records, as stored and decompressed."""
FOOTER_BYTES: Final = RECORD_HEADER.size + 20
_INDEXES: Final = (Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX)
_FEW: Final = 16
_FAR: Final = 2**62
"""No place of a file is as far, so that sums of a few are numbers of 64 bits."""

Run = tuple[int, int, int]
"""Records of one opcode and length, one after the other: content of the first, length, number."""


@dataclass(slots=True)
class Summary:
    """What stands between the data and the end of a log.

    Attributes:
        begin: place in the file where the data ends.
        file: the log, with its summary in memory unless that is large.
        read: it is there, and was read to its end.
        broken: it is damaged.
        chunks: places that it names for chunks, in order.
        indexes: its chunk, attachment and metadata indexes, those alike together.
    """

    begin: int
    file: Store
    read: bool = False
    broken: bool = False
    statistics: Statistics | None = None
    chunks: list[int] = field(default_factory=list)
    indexes: dict[int, list[Run]] = field(
        default_factory=lambda: {opcode: [] for opcode in _INDEXES}
    )

    def count(self, opcode: int) -> int:
        """How many indexes of a kind there are."""
        return sum(count for _, _, count in self.indexes[opcode])


def read_summary(file: Store, definitions: Definitions, refuse: Refuse) -> Summary | None:
    """Read the footer and the summary of a log, and take in what this defines.

    Returns:
        The summary as far as it can be read, or None where the file has no end.
    """
    footer_at = file.size - len(MAGIC) - FOOTER_BYTES
    if footer_at < len(MAGIC) or file.read(file.size - len(MAGIC), len(MAGIC)) != MAGIC:
        return None
    footer = file.read(footer_at, FOOTER_BYTES)
    opcode, length = RECORD_HEADER.unpack_from(footer)
    if opcode != Opcode.FOOTER or length != 20:
        refuse("footer", "it is no footer record")
        return None
    start, offsets, crc = struct.unpack_from("<QQI", footer, RECORD_HEADER.size)
    begin = start or offsets or footer_at
    if not len(MAGIC) <= begin <= footer_at or (offsets and not begin <= offsets <= footer_at):
        refuse("footer", "it points outside the file")
        return None
    if footer_at - begin <= MAX_DEFINITION:
        file = Excerpt(file, begin, file.size)
    summary = Summary(begin, file)
    if crc and file.crc(begin, footer_at + FOOTER_BYTES - 4) != crc:
        summary.broken = True
        refuse("summary", "its CRC does not match: damaged")
        return summary
    try:
        _take_records(file, summary, footer_at, definitions)
        summary.read = start == begin
    except MalformedRecord as error:
        summary.broken = True
        refuse("summary", str(error))
    summary.chunks.sort()
    return summary


def _take_records(file: Store, summary: Summary, stop: int, definitions: Definitions) -> None:
    at = summary.begin
    while at < stop:
        opcode, length = header_at(file, at)
        content, end = at + RECORD_HEADER.size, at + RECORD_HEADER.size + length
        if opcode == Opcode.CHUNK_INDEX and 24 <= length <= stop - content:
            rows = _alike(file, at, stop, RECORD_HEADER.size + length)
            starts = np.ascontiguousarray(rows[:, RECORD_HEADER.size + 16 :][:, :8]).view("<u8")
            summary.indexes[opcode].append((content, length, len(rows)))
            summary.chunks += starts[:, 0].tolist()
            at += rows.size
            continue
        if opcode == 0 or end > stop:
            raise MalformedRecord(f"no record at byte {at}")
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            definitions.add(opcode, definition(file, content, length), "summary")
        elif opcode == Opcode.STATISTICS:
            summary.statistics = statistics(definition(file, content, length))
        elif opcode in _INDEXES:
            summary.indexes[opcode].append((content, length, 1))
        elif opcode <= Opcode.DATA_END and opcode != Opcode.SUMMARY_OFFSET:
            raise MalformedRecord(f"a {Opcode(opcode).name} record among the summary")
        at = end


def header_at(file: Store, at: int) -> tuple[int, int]:
    """Opcode and length of the record at a place of the file, 0 where it ends before."""
    head = file.peek(at, RECORD_HEADER.size).ljust(RECORD_HEADER.size, b"\0")
    opcode, length = RECORD_HEADER.unpack(head)
    return opcode, length


def definition(file: Store, content: int, length: int) -> bytes:
    """Read a record that is kept in memory, and must not be too large for that.

    Raises:
        MalformedRecord: it is.
    """
    if length > MAX_DEFINITION:
        raise MalformedRecord(f"a record of {length} bytes, above the limit {MAX_DEFINITION}")
    return file.read(content, length)


def stated_segments(summary: Summary, known: set[int]) -> list[Segment] | None:
    """The chunks that a summary names, in file order, where it defines the `known` channels.

    Returns:
        None where the summary does not account for every message.

    Raises:
        MalformedRecord: a broken index.
    """
    stated = summary.statistics
    if stated is None or not summary.read:
        return None
    segments: list[Segment] = []
    for content, length, count in summary.indexes[Opcode.CHUNK_INDEX]:
        for segment in _segments(summary.file, content, length, count):
            if segment is None:
                return None
            segments.append(segment)
    segments.sort(key=lambda segment: segment.offset)
    begin = summary.begin
    edges = [(len(MAGIC), len(MAGIC)), *((s.offset, s.stop) for s in segments), (begin, begin)]
    if any(stop > start for (_, stop), (start, _) in itertools.pairwise(edges)):
        raise MalformedRecord("its chunk index names chunks that overlap")
    counts = [segment.channel_counts() or {} for segment in segments]
    accounted = (
        len(segments) == stated.chunks
        and summary.count(Opcode.METADATA_INDEX) == stated.metadata
        and summary.count(Opcode.ATTACHMENT_INDEX) == stated.attachments
        and sum(sum(c.values()) for c in counts) == stated.messages
        and all(c.keys() <= known for c in counts)
    )
    return segments if accounted else None


def stated_chunks(summary: Summary) -> list[Segment]:
    """The chunks of which a summary says everything but their CRC, in file order."""
    segments = []
    for content, length, count in summary.indexes[Opcode.CHUNK_INDEX] if summary.read else ():
        for i in range(count):
            at = content + i * (RECORD_HEADER.size + length)
            with contextlib.suppress(MalformedRecord):
                segment = _segment(_index(summary.file, at, length))
                segments += [segment] if segment else []
    return sorted(segments, key=lambda segment: segment.offset)


def stated_spans(summary: Summary, opcode: int) -> list[tuple[int, int]]:
    """Where a summary says that attachments or metadata are, as spans [start, stop) of the file.

    Raises:
        MalformedRecord: one is not within the data.
    """
    spans = []
    for content, length, _ in summary.indexes[opcode]:
        fields = _index(summary.file, content, length)
        start, size = fields.integer(8), fields.integer(8)
        if size < RECORD_HEADER.size or start + size > summary.begin:
            raise MalformedRecord("an index points outside the data")
        spans.append((start, start + size))
    return spans


def _index(file: Store, content: int, length: int) -> Fields:
    if length > MAX_CHUNK:
        raise MalformedRecord("an index is larger than any chunk")
    return Fields(file.read(content, length), "an index")


def _alike(file: Store, at: int, stop: int, width: int) -> ByteArray:
    """The record at a place, and those after it of its opcode and length, (n, width) bytes."""
    most, wanted = (stop - at) // width, 1
    while True:
        raw = np.frombuffer(file.read(at, min(wanted, most) * width), np.uint8)
        rows = raw[: len(raw) // width * width].reshape(-1, width)
        other = (rows[:, : RECORD_HEADER.size] != rows[0, : RECORD_HEADER.size]).any(axis=1)
        if other.any():
            return rows[: int(other.argmax())]
        if wanted >= most:
            return rows
        wanted *= _FEW


def _segments(file: Store, content: int, length: int, count: int) -> Iterator[Segment | None]:
    """The chunks of chunk indexes that follow one another; see `_segment`."""
    width = RECORD_HEADER.size + length
    found = None
    if count >= _FEW and count * width <= MAX_DEFINITION:
        raw = file.read(content - RECORD_HEADER.size, count * width)
        found = _columns(np.frombuffer(raw, np.uint8).reshape(count, width))
    if found is not None:
        yield from found
        return
    for i in range(count):
        yield _segment(_index(file, content + i * width, length))


def _columns(rows: ByteArray) -> list[Segment] | None:
    """The chunks of many chunk indexes alike; None where each is to be looked at.

    Args:
        rows: (n, width) records.
    """
    fixed = RECORD_HEADER.size + _CHUNK.size
    mapped = int.from_bytes(rows[0, fixed - 4 : fixed].tobytes(), "little")
    parts, rest = divmod(mapped, _PLACE.size)
    named = fixed + mapped + 8
    if rest or not parts or named + 4 > rows.shape[1]:
        return None
    name = int.from_bytes(rows[0, named : named + 4].tobytes(), "little")
    sizes = named + 4 + name
    if sizes + _SIZES.size > rows.shape[1]:
        return None

    def column(at: int, form: str) -> NDArray[Any]:
        return np.ascontiguousarray(rows[:, at : at + np.dtype(form).itemsize]).view(form)[:, 0]

    start, end, offset, length = (column(RECORD_HEADER.size + 8 * i, "<u8") for i in range(4))
    channels = [column(fixed + _PLACE.size * i, "<u2") for i in range(parts)]
    places = [column(fixed + _PLACE.size * i + 2, "<u8") for i in range(parts)]
    index, stored, size = (column(at, "<u8") for at in (named - 8, sizes, sizes + 8))
    same = np.r_[fixed - 4 : fixed, named:sizes]
    far = max(int(one.max()) for one in (offset, length, index, stored, *places)) >= _FAR
    if far or (rows[:, same] != rows[0, same]).any():
        return None
    data = offset + np.uint64(_FIXED + name)
    edges = [offset + length, *places[1:], offset + length + index]
    if (places[0] != edges[0]).any() or (length != data - offset + stored).any():
        return None
    columns = []
    for channel, (place, after) in zip(channels, itertools.pairwise(edges), strict=True):
        first = place.astype(np.int64) + INDEX_HEADER
        count, rest = np.divmod(after.astype(np.int64) - first, 16)
        if rest.any() or count.min() < 0:
            return None
        columns.append(map(IndexPart, channel.tolist(), first.tolist(), count.tolist()))
    try:
        compression = rows[0, named + 4 : sizes].tobytes().decode()
    except UnicodeDecodeError:
        return None
    numbers = zip(*(c.tolist() for c in (offset, data, stored, size, start, end)), strict=True)
    return [
        Segment(at, begin, held, whole, compression, 0, low, high, True, list(own), stated=True)
        for (at, begin, held, whole, low, high), own in zip(
            numbers, zip(*columns, strict=True), strict=True
        )
    ]


def _segment(fields: Fields) -> Segment | None:
    """The chunk of a chunk index, or None where only the chunk tells what it holds."""
    start, end, offset, length, mapped = fields.unpack(_CHUNK)
    raw = fields.take(mapped)
    if mapped % _PLACE.size:
        raise MalformedRecord("a chunk index is cut short")
    places = [(place, channel) for channel, place in _PLACE.iter_unpack(raw)]
    index_size, compression = fields.integer(8), fields.text()
    stored, size = fields.unpack(_SIZES)
    data = offset + _FIXED + len(compression.encode())
    if length != data - offset + stored:
        raise MalformedRecord("a chunk index lies about its chunk's length")
    places.sort()
    stop = offset + length + index_size
    if not places:
        return None
    if places[0][0] != offset + length:
        raise MalformedRecord("a chunk index lies about its message indexes")
    parts = []
    for (place, channel), (after, _) in itertools.pairwise([*places, (stop, 0)]):
        count, rest = divmod(after - place - INDEX_HEADER, 16)
        if rest or count < 0:
            return None
        parts.append(IndexPart(channel, place + INDEX_HEADER, count))
    return Segment(
        offset, data, stored, size, compression, 0, start, end, True, indexes=parts, stated=True
    )
