"""MCAP's records as bytes: what a log may contain, with every length checked.

Nothing here trusts a length, count or text of the file. Whoever reads a file turns
`MalformedRecord` into an error that names it.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from replay.storage.location import Location

RECORD_HEADER: Final = struct.Struct("<BQ")
MAX_CHUNK: Final = 144 * 1024 * 1024
"""Largest decompressed chunk, in bytes, that is read; asked for before decompressing."""
MAX_DEFINITION: Final = 64 * 1024 * 1024
"""Largest schema, channel or metadata record, in bytes, that is read."""

MESSAGE_HEADER: Final = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
INDEX_HEADER: Final = RECORD_HEADER.size + 6
"""Bytes before the pairs of a message index."""
MESSAGE_FIELDS: Final = MESSAGE_HEADER.itemsize - RECORD_HEADER.size


class MalformedRecord(LogDamagedError):  # noqa: N818 - says what is wrong with a record, not where
    """Bytes that are not what MCAP says they are; the reader adds file and place."""


def no_log(path: Location) -> CdmisfaError:
    """What is wrong with a file that begins otherwise: damage, where its name is that of a log."""
    if ".mcap" in path.name:
        return LogDamagedError(f"{path}: not an MCAP file (its first bytes are not MCAP's)")
    return UsageError(f"{path} is no MCAP file: name a recording, a run, or logs of cameras")


@dataclass(frozen=True, slots=True)
class Schema:
    """How messages of a channel are to be decoded."""

    id: int
    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Channel:
    """A stream of messages on a topic; `schema_id` 0 has no schema."""

    id: int
    schema_id: int
    topic: str
    encoding: str
    metadata: dict[str, str] = field(hash=False)


@dataclass(frozen=True, slots=True)
class Statistics:
    """How much the writer says the file holds."""

    messages: int
    attachments: int
    metadata: int
    chunks: int
    per_channel: dict[int, int] = field(hash=False)


class Fields:
    """The fields of one record, taken one after the other within its bounds."""

    def __init__(self, data: bytes | memoryview, what: str) -> None:
        self.data = memoryview(data)
        self.what = what
        self.at = 0

    def take(self, count: int) -> memoryview:
        """Take the next `count` bytes.

        Raises:
            MalformedRecord: there are fewer left.
        """
        if count > len(self.data) - self.at:
            raise MalformedRecord(
                f"{self.what} is cut short or lies about a length ({count} bytes wanted, "
                f"{len(self.data) - self.at} there)"
            )
        self.at += count
        return self.data[self.at - count : self.at]

    def integer(self, width: int) -> int:
        """Take an unsigned little-endian number of `width` bytes."""
        return int.from_bytes(self.take(width), "little")

    def unpack(self, layout: struct.Struct) -> tuple[Any, ...]:
        """Take what a layout describes."""
        return layout.unpack(self.take(layout.size))

    def text(self) -> str:
        """Take a text with its length in front.

        Raises:
            MalformedRecord: it is not UTF-8.
        """
        raw = self.take(self.integer(4))
        try:
            return str(raw, "utf-8")
        except UnicodeDecodeError:
            raise MalformedRecord(f"{self.what} holds a text that is not UTF-8") from None

    def texts(self) -> dict[str, str]:
        """Take a map of texts, where no key may stand twice: readers would disagree.

        Raises:
            MalformedRecord: one does.
        """
        inner = Fields(self.take(self.integer(4)), self.what)
        result: dict[str, str] = {}
        while inner.at < len(inner.data):
            key = inner.text()
            if key in result:
                raise MalformedRecord(f"{self.what} holds the key {key[:80]!r} twice")
            result[key] = inner.text()
        return result


def schema(content: bytes | memoryview) -> Schema:
    """A Schema record; raises MalformedRecord."""
    fields = Fields(content, "a schema")
    number = fields.integer(2)
    if number == 0:
        raise MalformedRecord("a schema has the id 0, which stands for none")
    return Schema(number, fields.text(), fields.text(), bytes(fields.take(fields.integer(4))))


def channel(content: bytes | memoryview) -> Channel:
    """A Channel record; raises MalformedRecord."""
    fields = Fields(content, "a channel")
    return Channel(
        fields.integer(2), fields.integer(2), fields.text(), fields.text(), fields.texts()
    )


def statistics(content: bytes | memoryview) -> Statistics:
    """A Statistics record; raises MalformedRecord."""
    fields = Fields(content, "the statistics")
    messages = fields.integer(8)
    fields.take(2 + 4)  # schemas and channels
    attachments, metadata, chunks = fields.integer(4), fields.integer(4), fields.integer(4)
    fields.take(8 + 8)  # first and last log time
    raw = fields.take(fields.integer(4))
    if len(raw) % 10:
        raise MalformedRecord("the statistics hold a broken count per channel")
    counts = np.frombuffer(raw, np.dtype([("channel", "<u2"), ("messages", "<u8")]))
    per_channel = {int(row["channel"]): int(row["messages"]) for row in counts}
    return Statistics(messages, attachments, metadata, chunks, per_channel)


def walk(data: memoryview, at: int, stop: int) -> Iterator[tuple[int, int, int]]:
    """Each record within a chunk as (opcode, place of its first byte, place after its last).

    Raises:
        MalformedRecord: bytes are left over, a record runs over the end, or is none.
    """
    unpack = RECORD_HEADER.unpack_from
    while at < stop:
        if stop - at < RECORD_HEADER.size:
            raise MalformedRecord(f"{stop - at} bytes at its end are no record")
        opcode, length = unpack(data, at)
        end = at + RECORD_HEADER.size + length
        if end > stop:
            raise MalformedRecord(f"a record at {at} runs {end - stop} bytes over its end")
        if opcode == 0:
            raise MalformedRecord(f"no record at {at} (opcode 0)")
        yield opcode, at, end
        at = end
