"""Read the summary at the end of a log: its counts and its index.

The summary is trusted only if it accounts for every message that it counts, and only for logs that
are not read completely; every chunk that is read is compared with it.
"""

from __future__ import annotations

import contextlib
import functools
import operator
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

from mcap.opcode import Opcode
from mcap.records import Statistics

from recorder.mcap.records import (
    CHUNK_HEADER,
    INDEX_HEADER,
    MAGIC,
    MAX_DEFINITION,
    RECORD_HEADER,
    Definitions,
    Fields,
    IndexPart,
    MalformedRecord,
    Refuse,
    Segment,
    crc32,
)
from recorder.mcap.store import Store

_FOOTER: Final = struct.Struct("<BQQQI")
_LENGTH: Final = struct.Struct("<I")
# Size of a chunk index before the offsets of its message indexes.
_BEFORE_PLACES: Final = 36
# Size of a chunk before its records, without the name of its compression.
_FIXED: Final = CHUNK_HEADER.size + 12
_INDEXES: Final = (Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX)


@dataclass(slots=True)
class Summary:
    """The records between the data section and the footer of a log.

    Attributes:
        begin: offset at which the data section ends.
        read: True if the summary exists and was read to its end.
        broken: True if it is damaged.
        statistics: its statistics, or None.
        named: offsets of the chunks in its index, sorted.
        indexes: contents of its chunk, attachment and metadata indexes.
    """

    begin: int
    read: bool = False
    broken: bool = False
    statistics: Statistics | None = None
    named: list[int] = field(default_factory=list)
    indexes: dict[int, list[bytes]] = field(default_factory=lambda: {o: [] for o in _INDEXES})

    def sound_chunks(self) -> list[Segment]:
        """Return the chunks that the summary states, without their CRC, in file order."""
        chunks = []
        for content in self.indexes[Opcode.CHUNK_INDEX] if self.read else ():
            with contextlib.suppress(MalformedRecord):
                chunks.append(_segment(content))
        return sorted(filter(None, chunks), key=lambda segment: segment.offset)

    def chunks(self, known: set[int]) -> list[Segment] | None:
        """Return the chunks in file order; None if they do not account for every message.

        Args:
            known: ids of the channels that the summary defines.

        Raises:
            MalformedRecord: an index is damaged.
        """
        stated = self.statistics
        if stated is None or not self.read:
            return None
        segments = [_segment(content) for content in self.indexes[Opcode.CHUNK_INDEX]]
        chunks = sorted(filter(None, segments), key=lambda segment: segment.offset)
        starts = [*(segment.offset for segment in chunks), self.begin]
        stops = [len(MAGIC), *(segment.stop for segment in chunks)]
        if any(map(operator.gt, stops, starts)):
            raise MalformedRecord("its chunk index names chunks that overlap")
        counts = [segment.channel_counts() or {} for segment in chunks]
        accounted = (
            len(chunks) == len(segments) == stated.chunk_count
            and len(self.indexes[Opcode.METADATA_INDEX]) == stated.metadata_count
            and len(self.indexes[Opcode.ATTACHMENT_INDEX]) == stated.attachment_count
            and sum(sum(c.values()) for c in counts) == stated.message_count
            and all(c.keys() <= known for c in counts)
        )
        return chunks if accounted else None

    def contradictions(self, segments: Sequence[Segment]) -> Iterator[str]:
        """Yield the contradictions between the summary and the segments of a walk."""
        if self.named and [s.offset for s in segments if s.chunked] != self.named:
            yield "its chunk index names other chunks than the file has"
        counts = [s.channel_counts() for s in segments]
        present = sum(sum(count.values()) for count in counts if count)
        stated = self.statistics.message_count if self.statistics else present
        if stated != present and None not in counts:
            yield f"it states {stated} messages, but the file has {present}"

    def ranges(self, opcode: int) -> list[tuple[int, int]]:
        """Return the ranges [start, stop) in the file of its attachments or metadata records.

        Raises:
            MalformedRecord: they are outside of the data section.
        """
        spans = []
        for content in self.indexes[opcode]:
            fields = Fields(content, "an index")
            start, size = fields.read8(), fields.read8()
            if size < RECORD_HEADER.size or start + size > self.begin:
                raise MalformedRecord("an index points outside of the data section")
            spans.append((start, start + size))
        return spans


def read_summary(file: Store, definitions: Definitions, refuse: Refuse) -> Summary | None:
    """Read the footer and the summary of a log, and add its definitions.

    Returns:
        The readable part of the summary; None if the file has no end.
    """
    footer_at = file.size - len(MAGIC) - _FOOTER.size
    if footer_at < len(MAGIC) or file.read(file.size - len(MAGIC), len(MAGIC)) != MAGIC:
        return None
    footer = file.read(footer_at, _FOOTER.size)
    opcode, length, start, offsets, crc = _FOOTER.unpack(footer)
    # Some writers state offset 0 for a summary, or for summary offsets, that they did not write.
    if opcode != Opcode.FOOTER or length != 20:
        refuse("footer", "it is not a footer record")
        return None
    begin = start or offsets or footer_at
    if not len(MAGIC) <= begin <= footer_at or (offsets and not begin <= offsets <= footer_at):
        refuse("footer", "it points outside of the file")
        return None
    summary = Summary(begin)
    if footer_at - begin > MAX_DEFINITION:
        return summary
    data = file.read(begin, footer_at - begin)
    if crc and crc32(footer[:-4], crc32(data)) != crc:
        summary.broken = True
        refuse("summary", "its CRC does not match")
        return summary
    try:
        _take_records(data, summary, definitions)
        summary.read = start == begin
    except MalformedRecord as error:
        summary.broken = True
        refuse("summary", str(error))
    summary.named.sort()
    return summary


def _take_records(data: bytes, summary: Summary, definitions: Definitions) -> None:
    at = 0
    while at < len(data):
        head = data[at : at + RECORD_HEADER.size].ljust(RECORD_HEADER.size, b"\0")
        opcode, length = RECORD_HEADER.unpack(head)
        content = data[at + RECORD_HEADER.size : at + RECORD_HEADER.size + length]
        if opcode == 0 or len(content) < length:
            raise MalformedRecord(f"there is no record at byte {summary.begin + at}")
        if (indexes := summary.indexes.get(opcode)) is not None:
            indexes.append(content)
            if opcode == Opcode.CHUNK_INDEX and length >= 24:
                summary.named += struct.unpack_from("<Q", content, 16)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            definitions.add(opcode, content, "summary")
        elif opcode == Opcode.STATISTICS:
            summary.statistics = Statistics.read(Fields(content, "the statistics"))
        elif opcode <= Opcode.DATA_END and opcode != Opcode.SUMMARY_OFFSET:
            raise MalformedRecord(f"the summary has a {Opcode(opcode).name} record")
        at += RECORD_HEADER.size + length


def _segment(content: bytes) -> Segment | None:
    """Return the chunk of a chunk index; None if it does not state the chunk's messages.

    The message indexes of a chunk follow it without gaps. Their offsets give their sizes, and so
    the number of messages of each channel, without reading the file there.
    """
    try:
        (mapped,) = _LENGTH.unpack_from(content, _BEFORE_PLACES - 4)
        (name,) = _LENGTH.unpack_from(content, _BEFORE_PLACES + mapped + 8)
        if mapped % 10 or mapped > 10 * 2**16 or name > len(content):
            raise ValueError("impossible lengths")
        fields = _layout(mapped // 10, name).unpack_from(content)
        start, end, offset, length, _, *places, index_size, _, raw, stored, size = fields
        compression = raw.decode()
    except (struct.error, ValueError):
        raise MalformedRecord("a chunk index is damaged") from None
    data, after = offset + _FIXED + name, offset + length
    if length != data - offset + stored:
        raise MalformedRecord("a chunk index states a wrong chunk length")
    if not places:
        return None
    # No `strict`, and no sort of one part: opening a log of many chunks spends its time here.
    parts = list(zip(places[1::2], places[::2]))  # noqa: B905
    if len(parts) > 1:
        parts.sort()
    if parts[0][0] != after:
        raise MalformedRecord("a chunk index states wrong offsets of message indexes")
    indexes: list[IndexPart] = []
    counts: dict[int, int] = {}
    after += index_size
    for place, channel in reversed(parts):
        first = place + INDEX_HEADER.size
        count, rest = divmod(after - first, 16)
        if rest or count < 0:
            return None
        indexes.append(IndexPart(channel, first, count))
        counts[channel] = counts.get(channel, 0) + count
        after = place
    indexes.reverse()
    values = offset, data, stored, size, compression, 0, start, end, True, indexes, counts
    return Segment(*values, stated=True)


@functools.lru_cache(8)
def _layout(parts: int, name: int) -> struct.Struct:
    """Return the layout of a chunk index: times, offset, length, indexes, compression, sizes."""
    return struct.Struct(f"<QQQQI{'HQ' * parts}QI{name}sQQ")
