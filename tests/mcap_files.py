"""MCAP files for tests, made byte by byte: every variant the format allows, and hostile ones."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable, Iterable
from typing import Any

import lz4.frame
import zstandard
from mcap.writer import Writer

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = range(1, 8)
CHUNK_INDEX, ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA = range(8, 13)
METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(13, 16)

PADDING = b"\x01\xff\xff"


def text(value: str) -> bytes:
    raw = value.encode()
    return struct.pack("<I", len(raw)) + raw


def texts(values: dict[str, str]) -> bytes:
    raw = b"".join(text(k) + text(v) for k, v in values.items())
    return struct.pack("<I", len(raw)) + raw


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def header(padding: bytes = b"") -> bytes:
    return record(HEADER, text("") + text("tests") + padding)


def schema(number: int = 1, name: str = "Example", data: bytes = b"\x04\x05\x06") -> bytes:
    return struct.pack("<H", number) + text(name) + text("c") + struct.pack("<I", len(data)) + data


def channel(number: int = 1, schema_id: int = 1, topic: str = "example") -> bytes:
    return struct.pack("<HH", number, schema_id) + text(topic) + text("a") + texts({"foo": "bar"})


def message(channel_id: int, sequence: int, log_time: int, publish: int, data: bytes) -> bytes:
    return struct.pack("<HIQQ", channel_id, sequence, log_time, publish) + data


def compress(data: bytes, compression: str) -> bytes:
    if compression == "zstd":
        return zstandard.ZstdCompressor().compress(data)
    return lz4.frame.compress(data) if compression == "lz4" else data


def chunk(
    data: bytes,
    start: int,
    end: int,
    *,
    compression: str = "",
    crc: bool = True,
    size: int | None = None,
    stored: bytes | None = None,
) -> bytes:
    stored = compress(data, compression) if stored is None else stored
    size = len(data) if size is None else size
    check = zlib.crc32(data) if crc else 0
    fields = struct.pack("<QQQI", start, end, size, check)
    return record(CHUNK, fields + text(compression) + struct.pack("<Q", len(stored)) + stored)


def finish(data: bytes, summary: bytes = b"", *, crc: bool = True, offsets: int = 0) -> bytes:
    """Add data end, summary, footer and magic to the data section (with its magic)."""
    data_end = record(DATA_END, struct.pack("<I", zlib.crc32(data) if crc else 0))
    start = len(data) + len(data_end) if summary else 0
    footer = struct.pack("<BQQQ", FOOTER, 20, start, offsets)
    check = zlib.crc32(summary + footer) if crc else 0
    return data + data_end + summary + footer + struct.pack("<I", check) + MAGIC


def written(
    times: Iterable[int], payload: Callable[[int], bytes], chunk_size: int, **options: Any
) -> bytes:
    """A log as others write it: messages of two topics by turns, a file and metadata."""
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=chunk_size, **options)
    writer.start(profile="p", library="l")
    schema = writer.register_schema("name", "encoding", b"data")
    channels = [writer.register_channel(topic, "raw", schema) for topic in ("/a", "/b")]
    writer.add_metadata("meta", {"key": "value"})
    writer.add_attachment(1, 2, "file", "text/plain", b"attached")
    for i, time in enumerate(times):
        writer.add_message(channels[i % 2], time, payload(i), max(time - 7, 0), i)
    writer.finish()
    return stream.getvalue()
