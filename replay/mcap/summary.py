"""Where the chunks of a log are, by its summary: for logs of which not every byte is read.

The summary is believed only where it accounts for every message it counts; every chunk is
compared with it when it is read.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

from mcap.opcode import Opcode

from replay.mcap.records import (
    INDEX_HEADER,
    MAGIC,
    MAX_CHUNK,
    RECORD_HEADER,
    Fields,
    MalformedRecord,
    Statistics,
    chunk_header,
)
from replay.mcap.segments import IndexPart, Segment
from replay.storage.store import RandomFile

_FIXED = RECORD_HEADER.size + 40
"""Bytes of a chunk before its records, without the name of its compression."""


@dataclass(frozen=True, slots=True)
class Spans:
    """Places in the file, from and up to before, of records that the summary names."""

    metadata: list[tuple[int, int]]
    attachments: list[tuple[int, int]]


def indexed_segments(
    file: RandomFile, begin: int, stop: int, statistics: Statistics | None, known: set[int]
) -> tuple[list[Segment], Spans] | None:
    """Find the chunks by their indexes.

    Args:
        file: the log.
        begin: where its summary begins.
        stop: where its footer begins.
        statistics: what the summary counts.
        known: the channels that the summary defines.

    Returns:
        The chunks in file order and where other records are, or None where the summary does
        not account for every message.

    Raises:
        MalformedRecord: a broken index.
    """
    if statistics is None:
        return None
    segments: list[Segment] = []
    spans = Spans([], [])
    at = begin
    while at < stop:
        opcode, length = RECORD_HEADER.unpack(file.peek(at, RECORD_HEADER.size))
        content, at = at + RECORD_HEADER.size, at + RECORD_HEADER.size + length
        if opcode == Opcode.CHUNK_INDEX:
            segment = _segment(Fields(_content(file, content, length), "a chunk index"))
            if segment is None:
                return None
            segments.append(segment)
        elif opcode in (Opcode.METADATA_INDEX, Opcode.ATTACHMENT_INDEX):
            fields = Fields(_content(file, content, length), "an index")
            start, size = fields.integer(8), fields.integer(8)
            if size < RECORD_HEADER.size or start + size > begin:
                raise MalformedRecord("an index points outside the data")
            place = spans.metadata if opcode == Opcode.METADATA_INDEX else spans.attachments
            place.append((start, start + size))
    segments.sort(key=lambda segment: segment.offset)
    edges = [(len(MAGIC), len(MAGIC)), *((s.offset, s.stop) for s in segments), (begin, begin)]
    if any(stop > start for (_, stop), (start, _) in itertools.pairwise(edges)):
        raise MalformedRecord("its chunk index names chunks that overlap")
    counts = [segment.channel_counts() or {} for segment in segments]
    accounted = (
        len(segments) == statistics.chunks
        and len(spans.metadata) == statistics.metadata
        and len(spans.attachments) == statistics.attachments
        and sum(sum(c.values()) for c in counts) == statistics.messages
        and all(c.keys() <= known for c in counts)
    )
    return (segments, spans) if accounted else None


def confirm(file: RandomFile, segment: Segment) -> None:
    """Compare a chunk, and its message indexes, with what the summary says of it.

    Raises:
        MalformedRecord: they differ.
    """
    head = file.read(segment.offset, segment.data_offset - segment.offset)
    opcode, length = RECORD_HEADER.unpack_from(head)
    if opcode != Opcode.CHUNK:
        raise MalformedRecord("the summary points to something that is no chunk")
    header = chunk_header(head[RECORD_HEADER.size :])
    data = segment.offset + RECORD_HEADER.size + header.length
    stated = (data, header.stored, header.size, header.compression, header.start, header.end)
    if length != header.length + header.stored or stated != (
        segment.data_offset,
        segment.stored,
        segment.size,
        segment.compression,
        segment.start,
        segment.end,
    ):
        raise MalformedRecord("it is not the chunk that the summary names")
    for part in segment.indexes:
        raw = Fields(file.read(part.offset - INDEX_HEADER, INDEX_HEADER), "a message index")
        fields = [raw.integer(width) for width in (1, 8, 2, 4)]
        size = 16 * part.count
        if fields != [Opcode.MESSAGE_INDEX, size + 6, part.channel, size]:
            raise MalformedRecord("its message index is not the one that the summary names")
    segment.crc = header.crc
    segment.stated = False


def _content(file: RandomFile, content: int, length: int) -> bytes:
    if length > MAX_CHUNK:
        raise MalformedRecord("an index is larger than any chunk")
    return file.read(content, length)


def _segment(fields: Fields) -> Segment | None:
    """The chunk of a chunk index, or None where only the chunk tells what it holds."""
    start, end, offset, length = (fields.integer(8) for _ in range(4))
    raw = Fields(fields.take(fields.integer(4)), "a chunk index")
    places: list[tuple[int, int]] = []
    while raw.at < len(raw.data):
        channel = raw.integer(2)
        places.append((raw.integer(8), channel))
    index_size, compression = fields.integer(8), fields.text()
    stored, size = fields.integer(8), fields.integer(8)
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
        offset,
        data,
        stored,
        size,
        compression,
        0,
        start,
        end,
        chunked=True,
        indexes=parts,
        stated=True,
    )
