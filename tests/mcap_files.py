"""MCAP files for tests, made byte by byte: every variant the format allows, and hostile ones."""

from __future__ import annotations

import io
import itertools
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import lz4.frame
import zstandard
from mcap.writer import Writer

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = range(1, 8)
CHUNK_INDEX, ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA = range(8, 13)
METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(13, 16)

KINDS = ("none", "one", "ten", "attachment", "metadata", "schemaless")
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


def variants() -> Iterator[tuple[str, frozenset[str]]]:
    """Every kind of content with every combination of features that applies to it."""
    for kind in KINDS:
        has = {
            "none": ("st", "sum", "pad"),
            "attachment": ("ax", "st", "sum", "pad"),
            "metadata": ("mdx", "st", "sum", "pad"),
        }.get(kind, ("ch", "chx", "mx", "rch", "rsh", "st", "sum", "pad"))
        if kind == "schemaless":
            has = tuple(f for f in has if f != "rsh")
        for count in range(len(has) + 1):
            for chosen in itertools.combinations(has, count):
                if "ch" in chosen or not {"chx", "mx"} & set(chosen):
                    yield kind, frozenset(chosen)


def messages_of(kind: str) -> list[tuple[int, int, int, bytes]]:
    """(sequence, log time, publish time, data) of the messages a kind has."""
    count = {"one": 1, "ten": 10, "schemaless": 1}.get(kind, 0)
    return [(10 + i, 2 + i, 1 + i, bytes([1, 2, i])) for i in range(count)]


def variant(kind: str, features: frozenset[str], compression: str = "", crc: bool = True) -> bytes:
    """A valid file with some content, written with some of the format's options."""
    padding = PADDING if "pad" in features else b""
    outside = b"" if "ch" in features else padding
    out = bytearray(MAGIC + header(padding))
    definitions: list[tuple[int, bytes]] = []
    messages = messages_of(kind)
    if messages and kind != "schemaless":
        definitions.append((SCHEMA, schema() + outside))
    if messages:
        definitions.append((CHANNEL, channel(schema_id=0 if kind == "schemaless" else 1) + outside))
    body = b"".join(record(*d) for d in definitions)
    index: list[tuple[int, int]] = []
    for sequence, log_time, publish, data in messages:
        index.append((log_time, len(body)))
        body += record(MESSAGE, message(1, sequence, log_time, publish, data))
    groups: dict[int, bytes] = {}
    if messages and "ch" in features:
        place, times = len(out), (messages[0][1], messages[-1][1])
        made = chunk(body, *times, compression=compression, crc=crc)
        out += made
        index_at = len(out)
        if "mx" in features:
            pairs = b"".join(struct.pack("<QQ", *pair) for pair in index)
            content = struct.pack("<HI", 1, len(pairs)) + pairs
            out += record(MESSAGE_INDEX, content + padding)
        if "chx" in features:
            offsets = struct.pack("<HQ", 1, index_at) if "mx" in features else b""
            groups[CHUNK_INDEX] = record(
                CHUNK_INDEX,
                struct.pack("<QQQQ", *times, place, len(made))
                + struct.pack("<I", len(offsets))
                + offsets
                + struct.pack("<Q", len(out) - index_at)
                + text(compression)
                + struct.pack("<QQ", len(compress(body, compression)), len(body))
                + padding,
            )
    else:
        out += body
    if kind == "attachment":
        content = struct.pack("<QQ", 2, 1) + text("myFile") + text("application/octet-stream")
        content += struct.pack("<Q", 3) + b"\x01\x02\x03"
        made = record(ATTACHMENT, content + struct.pack("<I", zlib.crc32(content) if crc else 0))
        if "ax" in features:
            groups[ATTACHMENT_INDEX] = record(
                ATTACHMENT_INDEX,
                struct.pack("<QQQQQ", len(out), len(made), 2, 1, 3)
                + text("myFile")
                + text("application/octet-stream")
                + padding,
            )
        out += made
    if kind == "metadata":
        made = record(METADATA, text("myMetadata") + texts({"foo": "bar"}) + padding)
        if "mdx" in features:
            groups[METADATA_INDEX] = record(
                METADATA_INDEX,
                struct.pack("<QQ", len(out), len(made)) + text("myMetadata") + padding,
            )
        out += made
    for opcode, content in definitions:
        if ("rsh" if opcode == SCHEMA else "rch") in features:
            groups[opcode] = record(opcode, content)
    if "st" in features:
        counts = struct.pack("<HQ", 1, len(messages)) if messages else b""
        groups[STATISTICS] = record(
            STATISTICS,
            struct.pack(
                "<QHIIII",
                len(messages),
                sum(opcode == SCHEMA for opcode, _ in definitions),
                1 if messages else 0,
                int(kind == "attachment"),
                int(kind == "metadata"),
                1 if messages and "ch" in features else 0,
            )
            + struct.pack("<QQI", 2, 1 + len(messages), len(counts))
            + counts
            + padding,
        )
    data = bytes(out)
    start = len(data) + len(record(DATA_END, b"1234"))
    summary, offsets = b"", b""
    for opcode, content in groups.items():
        where = start + len(summary)
        offsets += record(
            SUMMARY_OFFSET, struct.pack("<BQQ", opcode, where, len(content)) + padding
        )
        summary += content
    if "sum" not in features or not summary:
        return finish(data, summary, crc=crc)
    return finish(data, summary + offsets, crc=crc, offsets=start + len(summary))
