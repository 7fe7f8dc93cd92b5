"""Parse the records of MCAP, with every length checked.

Nothing here trusts a length, count or text of the file. Callers turn a `MalformedRecord` into an
error that names the file.
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

MAGIC: Final = b"\x89MCAP0\r\n"  # the first and the last bytes of a file
RECORD_HEADER: Final = struct.Struct("<BQ")

# Larger chunks and definitions are refused before memory is asked for. Writers make chunks of 1 to
# 4 MiB by default; 144 MiB hold an image of 8192x6144 in RGB.
MAX_CHUNK: Final = 144 * 1024 * 1024
MAX_DEFINITION: Final = 64 * 1024 * 1024

# Opcode, length, channel, sequence, log time, publish time; the payload follows.
MESSAGE_HEADER: Final = struct.Struct("<BQHIQQ")
# Opcode, length, channel, bytes of the pairs of log time and place in the chunk, which follow.
INDEX_HEADER: Final = struct.Struct("<BQHI")
# Opcode, length, first and last log time, size and CRC; compression and records follow.
CHUNK_HEADER: Final = struct.Struct("<BQQQQI")
# Bytes that hold all of a chunk before its records: the name of its compression is short.
CHUNK_PEEK: Final = 256


class MalformedRecord(LogDamagedError):  # noqa: N818 - says what is wrong with a record, not where
    """A record contradicts the format; the reader adds file and place."""


# The formats that are read, for errors; docs/how-to/open-data.md describes each.
KINDS: Final = (
    "logs are .mcap, .bag and .db3 files, videos (.mp4, .m4v, .mov, .mkv, .webm, .avi, .wmv, .mpg, "
    ".mpeg), tables (.csv, .parquet), folders of .png or .jpg files, LeRobot datasets, and arrays "
    "(.npy, .npz)"
)


def no_log(path: Path) -> CdmisfaError:
    """Return the error for a file that does not begin as MCAP; damage if it is named as MCAP."""
    if ".mcap" in path.name:
        return LogDamagedError(f"{path}: not an MCAP file (its first bytes are not MCAP's)")
    if path.suffix in (".npy", ".npz"):
        return UsageError(
            f"{path} holds arrays: make a recording of them with cdmisfa convert {path} -o REC"
        )
    return UsageError(f"{path} is no log that is read: {KINDS}")


class Fields(ReadDataStream):
    """Read the fields of one record, one after the other, within its bounds."""

    def __init__(self, data: bytes | memoryview, what: str) -> None:
        super().__init__(io.BytesIO(data))
        self._size, self._what = len(data), what

    def read(self, length: int) -> bytes:
        """Return the next bytes.

        Raises:
            MalformedRecord: there are fewer left.
        """
        left = self._size - self.count
        if length > left:
            raise MalformedRecord(
                f"{self._what} is cut short or lies about a length ({length} bytes wanted, "
                f"{left} there)"
            )
        return bytes(super().read(length))

    def read_prefixed_string(self) -> str:
        """Return a text with its length in front.

        Raises:
            MalformedRecord: it is not UTF-8.
        """
        try:
            return str(super().read_prefixed_string())
        except UnicodeDecodeError:
            raise MalformedRecord(f"{self._what} holds a text that is not UTF-8") from None


def crc32(data: bytes | memoryview, value: int = 0) -> int:
    """Return the CRC-32 of bytes, continued from the `value` of the bytes before."""
    return int(_crc32(data, value))


def chunk_head(start: int, end: int, size: int, crc: int, compression: str, stored: int) -> bytes:
    """Return the bytes of a chunk before its records; see `Segment`."""
    name = compression.encode()
    length = CHUNK_HEADER.size + 12 + len(name) + stored - RECORD_HEADER.size
    head = CHUNK_HEADER.pack(Opcode.CHUNK, length, start, end, size, crc)
    return head + struct.pack(f"<I{len(name)}sQ", len(name), name, stored)


# Takes (where, what) of a damage: raises, or notes it where damage is left out.
Refuse = Callable[[str, str], None]


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
        stated: it is known from the summary, its own header was not read.
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
        """Parse the header of a chunk at a place in the file."""
        fields = Fields(content, "a chunk")
        start, end, size = fields.read8(), fields.read8(), fields.read8()
        crc, compression, stored = fields.read4(), fields.read_prefixed_string(), fields.read8()
        data = offset + RECORD_HEADER.size + fields.count
        return cls(offset, data, stored, size, compression, crc, start, end, chunked=True)

    def within(self, end: int) -> Segment:
        """Return a chunk whose data must not run over the end of its record."""
        if self.data_end > end:
            raise MalformedRecord("a chunk's length is not that of its data")
        return self

    def head(self, crc: int) -> bytes:
        """Return the bytes of a chunk before its records, given their CRC."""
        return chunk_head(self.start, self.end, self.size, crc, self.compression, self.stored)

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
        """Name in errors."""
        kind = "chunk" if self.chunked else "messages"
        return f"{kind} at byte {self.offset} (log time {self.start} to {self.end} ns)"

    def channel_counts(self) -> dict[int, int] | None:
        """Return the messages of each channel, or None if only decoding can tell."""
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
    """A file within the log, whose bytes are at `offset`."""

    name: str
    media_type: str
    log_time: int
    create_time: int
    offset: int
    size: int


@dataclass(frozen=True, slots=True)
class Problem:
    """Damage of a log, or a loss."""

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
        """Add a Schema or Channel record; refuse one whose id has another meaning.

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
        fields = Fields(content, "a schema" if is_schema else "a channel")
        new = Schema.read(fields) if is_schema else Channel.read(fields)
        known: dict[int, Any] = self.schemas if is_schema else self.channels
        if known.setdefault(new.id, new) != new:
            kind = "schema" if is_schema else "channel"
            self._refuse(where, f"{kind} {new.id} is defined twice with different content")
        self._seen.add(key)
