"""What a log is made of: its chunks, definitions, metadata and attachments."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from mcap.opcode import Opcode

from replay.mcap.records import (
    MAX_DEFINITION,
    RECORD_HEADER,
    Channel,
    Fields,
    MalformedRecord,
    Schema,
    channel,
    schema,
)

Refuse = Callable[[str, str], None]
"""Takes (where, what) of a damage: raises, or notes it where damage is left out."""


@dataclass(slots=True)
class IndexPart:
    """The message index of one channel in one chunk: `count` pairs at `offset` in the file."""

    channel: int
    offset: int
    count: int


@dataclass(slots=True)
class Segment:
    """A chunk, or messages outside chunks that follow one another.

    Attributes:
        offset: place in the file of its first record.
        data_offset: place in the file of its (compressed) records.
        stored: bytes there.
        size: bytes once decompressed.
        crc: CRC-32 of the decompressed bytes, 0 where the writer gave none.
        start: log time of its earliest message.
        end: log time of its latest message.
        indexes: the chunk's message indexes, in file order.
        counts: messages of each channel where a walk counted them.
        cut: the file ends within it.
        stated: only the summary speaks of it, its own header was not read.
    """

    offset: int
    data_offset: int
    stored: int
    size: int
    compression: str
    crc: int
    start: int
    end: int
    chunked: bool
    indexes: list[IndexPart] = field(default_factory=list)
    counts: dict[int, int] | None = None
    cut: bool = False
    stated: bool = False

    @classmethod
    def of_chunk(cls, offset: int, content: bytes | memoryview) -> Segment:
        """A chunk whose record stands at a place in the file, by what it says of itself."""
        fields = Fields(content, "a chunk")
        start, end, size = fields.integer(8), fields.integer(8), fields.integer(8)
        crc, compression, stored = fields.integer(4), fields.text(), fields.integer(8)
        data = offset + RECORD_HEADER.size + fields.at
        return cls(offset, data, stored, size, compression, crc, start, end, chunked=True)

    @property
    def data_end(self) -> int:
        """Place in the file after its records."""
        return self.data_offset + self.stored

    @property
    def stop(self) -> int:
        """Place in the file after its message indexes."""
        if not self.indexes:
            return self.data_end
        last = self.indexes[-1]
        return last.offset + 16 * last.count

    @property
    def name(self) -> str:
        """How an error names it."""
        kind = "chunk" if self.chunked else "messages"
        return f"{kind} at byte {self.offset} (log time {self.start} to {self.end} ns)"

    def channel_counts(self) -> dict[int, int] | None:
        """Messages of each channel, or None where only decoding can tell."""
        if self.counts is not None:
            return self.counts
        if not self.indexes:
            return {} if self.size == 0 else None
        counts: dict[int, int] = {}
        for part in self.indexes:
            counts[part.channel] = counts.get(part.channel, 0) + part.count
        return counts


@dataclass(frozen=True, slots=True)
class Metadata:
    """A named map of texts."""

    name: str
    values: dict[str, str] = field(hash=False)


@dataclass(frozen=True, slots=True)
class Attachment:
    """A file within the log; `offset` and `size` are those of its bytes."""

    name: str
    media_type: str
    log_time: int
    create_time: int
    offset: int
    size: int
    crc: int


@dataclass(frozen=True, slots=True)
class Problem:
    """Something that is wrong with a log, or was lost of it."""

    where: str
    what: str


@dataclass(frozen=True, slots=True)
class Message:
    """One message of a log; times in nanoseconds."""

    channel: Channel
    sequence: int
    log_time: int
    publish_time: int
    data: bytes


class Definitions:
    """The schemas and channels of a log; an id has one meaning."""

    def __init__(self, refuse: Refuse) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self._refuse = refuse
        self._seen: set[tuple[int, bytes]] = set()
        self._bytes = 0

    def add(self, opcode: int, content: bytes, where: str) -> None:
        """Take a Schema or Channel record in; one whose id means something else is refused.

        Raises:
            MalformedRecord: it is no such record, or all of them take too much memory.
        """
        key = (opcode, content)
        if key in self._seen:
            return
        self._bytes += len(content)
        if self._bytes > MAX_DEFINITION:
            raise MalformedRecord(f"schemas and channels take more than {MAX_DEFINITION} bytes")
        is_schema = opcode == Opcode.SCHEMA
        new = schema(content) if is_schema else channel(content)
        known: dict[int, Any] = self.schemas if is_schema else self.channels
        if known.setdefault(new.id, new) != new:
            kind = "schema" if is_schema else "channel"
            self._refuse(where, f"{kind} {new.id} is defined twice with different content")
        self._seen.add(key)
