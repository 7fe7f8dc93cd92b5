"""Records of MCAP, parsed with a check of every length.

No length, count or text in a file is trusted. Callers turn a `MalformedRecord` into an error that
names the file.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError

try:  # the same checksum, several times faster
    from isal.isal_zlib import crc32 as _crc32
except ImportError:
    from zlib import crc32 as _crc32

MAGIC: Final = b"\x89MCAP0\r\n"  # first and last bytes of a file
RECORD_HEADER: Final = struct.Struct("<BQ")

# Largest chunk and definition (bytes); larger ones are refused before memory is allocated. Writers
# make chunks of 1 to 4 MiB by default; 144 MiB hold an RGB image of 8192x6144.
MAX_CHUNK: Final = 144 * 1024 * 1024
MAX_DEFINITION: Final = 64 * 1024 * 1024

# Opcode, length, channel, sequence, log time, publish time; the payload follows.
MESSAGE_HEADER: Final = struct.Struct("<BQHIQQ")
# Opcode, length, channel, size of the pairs (log time, offset in the chunk) that follow.
INDEX_HEADER: Final = struct.Struct("<BQHI")
# Opcode, length, first and last log time, size and CRC; compression and records follow.
CHUNK_HEADER: Final = struct.Struct("<BQQQQI")
# Bytes that hold all of a chunk before its records, because names of compressions are short.
CHUNK_PEEK: Final = 256


class MalformedRecord(LogDamagedError):  # noqa: N818 - it names the problem, not yet the file
    """Record that contradicts the format; the reader adds file and offset."""


# Supported formats, for errors.
KINDS: Final = (
    "logs are .mcap, .bag and .db3 files, videos (.mp4, .m4v, .mov, .mkv, .webm, .avi, .wmv, .mpg, "
    ".mpeg), tables (.csv, .parquet), folders of .png or .jpg files, LeRobot datasets, and arrays "
    "(.npy, .npz)"
)


def no_log(path: Path) -> CdmisfaError:
    """Return the error for a file that does not begin as MCAP: damage if its name is .mcap."""
    if ".mcap" in path.name:
        return LogDamagedError(f"{path}: not an MCAP file (its first bytes are not MCAP's)")
    if path.suffix in (".npy", ".npz"):
        return UsageError(
            f"{path} holds arrays: make a recording of them with cdmisfa convert {path} -o REC"
        )
    return UsageError(f"{path} is not a supported log: {KINDS}")


class Fields(ReadDataStream):
    """Reader of the fields of one record, which does not read beyond its end."""

    def __init__(self, data: bytes | memoryview, record: str) -> None:
        super().__init__(io.BytesIO(data))
        self._size, self._record = len(data), record

    def read(self, length: int) -> bytes:
        """Return the next bytes.

        Raises:
            MalformedRecord: fewer bytes are left.
        """
        left = self._size - self.count
        if length > left:
            raise MalformedRecord(
                f"{self._record} is cut short or states a wrong length (it needs {length} bytes, "
                f"and {left} are left)"
            )
        return bytes(super().read(length))

    def read_prefixed_string(self) -> str:
        """Return a text that follows its length.

        Raises:
            MalformedRecord: the text is not UTF-8.
        """
        try:
            return str(super().read_prefixed_string())
        except UnicodeDecodeError:
            raise MalformedRecord(f"{self._record} has a text that is not UTF-8") from None


def crc32(data: bytes | memoryview, value: int = 0) -> int:
    """Return the CRC-32 of bytes, continued from the CRC `value` of earlier bytes."""
    return int(_crc32(data, value))


def chunk_head(start: int, end: int, size: int, crc: int, compression: str, stored: int) -> bytes:
    """Return the bytes of a chunk before its records; see `Segment`."""
    name = compression.encode()
    length = CHUNK_HEADER.size + 12 + len(name) + stored - RECORD_HEADER.size
    head = CHUNK_HEADER.pack(Opcode.CHUNK, length, start, end, size, crc)
    return head + struct.pack(f"<I{len(name)}sQ", len(name), name, stored)


# Called with (place, problem) for damage; it raises an error, or notes the damage if it is skipped.
Refuse = Callable[[str, str], None]


@dataclass(slots=True)
class IndexPart:
    """Message index of one channel in one chunk: `count` pairs at `offset` in the file."""

    channel: int
    offset: int
    count: int


@dataclass(slots=True)
class Segment:
    """A chunk, or a stretch of messages outside chunks.

    Attributes:
        offset: offset in the file of the first record.
        data_offset: offset in the file of the (compressed) records.
        stored: stored size of the records (bytes).
        size: decompressed size of the records (bytes).
        compression: "zstd", "lz4" or "".
        crc: CRC-32 of the decompressed records; 0: none.
        start: log time of the earliest message (ns).
        end: log time of the latest message (ns).
        chunked: True for a chunk.
        indexes: the chunk's message indexes, in file order.
        counts: number of messages of each channel, if a walk counted them.
        cut: True if the file ends within it.
        stated: True if only the summary states it, and its own header was not read.
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
        """Parse the header of a chunk at an offset in the file."""
        fields = Fields(content, "a chunk")
        start, end, size = fields.read8(), fields.read8(), fields.read8()
        crc, compression, stored = fields.read4(), fields.read_prefixed_string(), fields.read8()
        data = offset + RECORD_HEADER.size + fields.count
        return cls(offset, data, stored, size, compression, crc, start, end, chunked=True)

    def within(self, end: int) -> Segment:
        """Return the chunk, after a check that its data end within its record."""
        if self.data_end > end:
            raise MalformedRecord("the length of a chunk contradicts its data")
        return self

    def head(self, crc: int) -> bytes:
        """Return the bytes of a chunk before its records, for a CRC of the records."""
        return chunk_head(self.start, self.end, self.size, crc, self.compression, self.stored)

    @property
    def data_end(self) -> int:
        """Offset in the file after the records."""
        return self.data_offset + self.stored

    @property
    def stop(self) -> int:
        """Offset in the file after the message indexes."""
        if not self.indexes:
            return self.data_end
        last = self.indexes[-1]
        return last.offset + 16 * last.count

    @property
    def name(self) -> str:
        """Name of the segment in errors."""
        kind = "chunk" if self.chunked else "messages"
        return f"{kind} at byte {self.offset} (log time {self.start} to {self.end} ns)"

    def channel_counts(self) -> dict[int, int] | None:
        """Return the number of messages of each channel; None if only decoding can tell."""
        if self.counts is not None:
            return self.counts
        if not self.indexes:
            return {} if self.size == 0 else None
        counts: dict[int, int] = {}
        for part in self.indexes:
            counts[part.channel] = counts.get(part.channel, 0) + part.count
        return counts


@dataclass(frozen=True, slots=True)
class Attachment:
    """A file in the log, whose bytes are at `offset`."""

    name: str
    media_type: str
    log_time: int
    create_time: int
    offset: int
    size: int


@dataclass(frozen=True, slots=True)
class Problem:
    """Damage or loss in a log: the place, and a description."""

    where: str
    what: str


@dataclass(slots=True)  # not frozen: creating it would take four times as long
class Message:
    """A message of a log; times in ns."""

    channel: Channel
    sequence: int
    log_time: int
    publish_time: int
    data: bytes


class Definitions:
    """The schemas and channels of a log, each with one meaning for an id."""

    def __init__(self, refuse: Refuse) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self._refuse = refuse
        self._seen: set[tuple[int, bytes]] = set()
        self._bytes = 0

    def add(self, opcode: int, content: bytes, place: str) -> None:
        """Add a Schema or Channel record; refuse one whose id has another meaning.

        Raises:
            MalformedRecord: the record is not valid, or all of them take too much memory.
        """
        key = (opcode, content)
        if key in self._seen:
            return
        self._bytes += len(content)
        if self._bytes > MAX_DEFINITION:
            raise MalformedRecord(f"schemas and channels take more than {MAX_DEFINITION} bytes")
        is_schema = opcode == Opcode.SCHEMA
        fields = Fields(content, "a schema" if is_schema else "a channel")
        new = Schema.read(fields) if is_schema else Channel.read(fields)
        known: dict[int, Any] = self.schemas if is_schema else self.channels
        if known.setdefault(new.id, new) != new:
            kind = "schema" if is_schema else "channel"
            self._refuse(place, f"{kind} {new.id} is defined twice with different content")
        self._seen.add(key)
