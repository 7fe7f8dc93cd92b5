"""Logs broken on purpose: real files taken apart into records, changed, and put together again.

A log is changed where a bug, a disk or an attacker would change it: fields, lengths, offsets,
ids, names and whole records, within chunks and outside them, with checksums and indexes
made right again afterwards, or not. The same number gives the same file.
"""

from __future__ import annotations

import contextlib
import struct
import tempfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import mcap_files as files
import numpy as np
from mcap.writer import CompressionType, IndexType

from cdmisfa.core.blocks import Block, SourceSpec
from recorder.config import RecordConfig
from recorder.log.manifest import RecordingSpec
from recorder.log.viewlog import ViewLog
from tools.torture.mutations import BYTES

FRAMES = 20
SHAPE = (2, 3)
TRUTH = ("x", "y")
HEADER = struct.Struct("<BQ")

_FIELDS = {
    files.CHANNEL: ("channel", [(0, 2), (2, 2), (4, 4)]),
    files.SCHEMA: ("schema", [(0, 2), (2, 4)]),
    files.MESSAGE: ("message", [(0, 2), (2, 4), (6, 8), (14, 8)]),
    files.CHUNK: ("chunk", [(0, 8), (8, 8), (16, 8), (24, 4), (28, 4)]),
    files.MESSAGE_INDEX: ("message index", [(0, 2), (2, 4), (6, 8), (14, 8)]),
    files.CHUNK_INDEX: ("chunk index", [(0, 8), (8, 8), (16, 8), (24, 8), (32, 4), (36, 2)]),
    files.ATTACHMENT: ("attachment", [(0, 8), (8, 8), (16, 4), (-4, 4)]),
    files.STATISTICS: ("statistics", [(0, 8), (8, 2), (10, 4), (14, 4), (18, 4), (22, 4), (42, 4)]),
    files.METADATA: ("metadata", [(0, 4)]),
    files.DATA_END: ("data end", [(0, 4)]),
    files.FOOTER: ("footer", [(0, 8), (8, 8), (16, 4)]),
    files.HEADER: ("header", [(0, 4)]),
    files.SUMMARY_OFFSET: ("summary offset", [(0, 1), (1, 8), (9, 8)]),
}


@dataclass(slots=True)
class Record:
    """One record; `length` where it lies about its own.

    A chunk whose records are to be changed has them in `inner`.
    """

    opcode: int
    content: bytes
    length: int | None = None
    inner: list[Record] | None = None

    def raw(self) -> bytes:
        """Its bytes."""
        length = len(self.content) if self.length is None else self.length
        return HEADER.pack(self.opcode & 0xFF, length & (2**64 - 1)) + self.content


@dataclass(slots=True)
class Case:
    """A broken log.

    Attributes:
        raw: the file.
        base: name of the log it was made from.
        trusted: no checksum was made right again, so what passes one is what was written.
    """

    raw: bytes
    base: str
    trusted: bool


@dataclass(slots=True)
class _Log:
    """A log taken apart: the records up to the data end, those of the summary, the footer."""

    base: str
    data: list[Record]
    summary: list[Record]
    footer: Record
    fix_outer: bool = False
    fix_chunks: bool = False
    fix_index: bool = False
    inner_changed: bool = False

    def copy(self) -> _Log:
        """A copy to be changed."""
        return _Log(self.base, _copied(self.data), _copied(self.summary), _copied([self.footer])[0])


def _copied(records: list[Record]) -> list[Record]:
    return [
        Record(r.opcode, r.content, r.length, None if r.inner is None else _copied(r.inner))
        for r in records
    ]


def frames_of(t: int) -> bytes:
    """The pixels of frame t."""
    return bytes((17 * t + 5 * k + 1) % 256 for k in range(6))


def _recording(folder: Path, compression: str) -> bytes:
    spec = SourceSpec(("left",), SHAPE, "uint8", TRUTH, 50.0, 10**9)
    settings = RecordConfig(compression=compression, chunk_size=1024)  # type: ignore[arg-type]
    log = ViewLog(folder, "left", RecordingSpec("fuzz", 0, spec, {}), settings)
    pixels = np.frombuffer(b"".join(map(frames_of, range(FRAMES))), np.uint8)
    truth = np.arange(FRAMES * 2, dtype=np.float64).reshape(FRAMES, 2)
    log.write(Block(0, 0, pixels.reshape(FRAMES, *SHAPE), truth))
    log.finish()
    return (folder / "left.mcap").read_bytes()


def _other(**options: Any) -> bytes:
    times = (7 * i % 20 for i in range(FRAMES))
    return files.written(times, lambda i: bytes([i]) * (9 + i % 7), 180, **options)


@cache
def bases() -> dict[str, bytes]:
    """Whole logs of every layout, by name; those of `recording` can be learned from."""
    found: dict[str, bytes] = {}
    for compression in ("zstd", "lz4", "none"):
        with tempfile.TemporaryDirectory() as folder:
            found[f"recording {compression}"] = _recording(Path(folder), compression)
    for name, kind in [
        ("zstd", CompressionType.ZSTD),
        ("lz4", CompressionType.LZ4),
        ("none", CompressionType.NONE),
    ]:
        found[f"chunks {name}"] = _other(compression=kind, enable_data_crcs=True)
    found["no index"] = _other(
        index_types=IndexType.NONE, use_statistics=False, use_summary_offsets=False
    )
    found["no repetition"] = _other(repeat_channels=False, repeat_schemas=False)
    found["no checksums"] = _other(enable_crcs=False)
    found["no chunks"] = _other(use_chunking=False, enable_data_crcs=True)
    return found


@cache
def _taken_apart(base: str) -> _Log:
    raw = bases()[base]
    records = _records(raw, len(files.MAGIC), len(raw) - len(files.MAGIC))
    end = next(i for i, r in enumerate(records) if r.opcode == files.DATA_END) + 1
    for one in records[:end]:
        if one.opcode == files.CHUNK:
            one.inner = _inner(one.content)
    return _Log(base, records[:end], records[end:-1], records[-1])


def _records(raw: bytes, at: int, stop: int) -> list[Record]:
    found = []
    while at < stop:
        opcode, length = HEADER.unpack_from(raw, at)
        found.append(Record(opcode, raw[at + 9 : at + 9 + length]))
        at += 9 + length
    return found


def _chunk_parts(content: bytes) -> tuple[bytes, int, str, bytes]:
    """Times, size, compression and stored bytes of a whole chunk."""
    size, _, length = struct.unpack_from("<QII", content, 16)
    name = content[32 : 32 + length].decode()
    return content[:16], size, name, content[40 + length :]


def _inner(content: bytes) -> list[Record]:
    from recorder.mcap.chunks import decompressed

    _, size, name, stored = _chunk_parts(content)
    records = decompressed(np.frombuffer(stored, np.uint8), name, size)
    return _records(records.tobytes(), 0, size)


def mutated(number: int) -> Case:
    """The broken log with a number."""
    random = Random(number)
    base = random.choice(list(bases()))
    if random.random() < 0.2:
        return Case(_bytes_changed(random, bases()[base]), base, trusted=True)
    log = _taken_apart(base).copy()
    log.fix_outer = random.random() < 0.8
    log.fix_chunks = log.fix_outer and random.random() < 0.8
    log.fix_index = log.fix_outer and random.random() < 0.6
    for _ in range(random.choice((1, 1, 1, 2, 2, 3, 5))):
        random.choices(_KINDS, _WEIGHTS)[0](random, log)
    raw = _together(log)
    if random.random() < 0.1:
        raw = _bytes_changed(random, raw)
    return Case(raw, base, trusted=not log.fix_outer)


# Putting together


def _together(log: _Log) -> bytes:
    out = bytearray(files.MAGIC)
    indexes: list[bytes] = []
    skip = False
    for one in log.data:
        if one.opcode == files.MESSAGE_INDEX and skip and log.fix_index:
            continue
        if one.opcode == files.CHUNK and one.inner is not None:
            body = one.content
            if log.inner_changed:
                with contextlib.suppress(struct.error, UnicodeDecodeError):
                    body = _packed(one, log.fix_chunks)
            at = len(out)
            out += Record(files.CHUNK, body, one.length).raw()
            skip = True
            if log.fix_index:
                indexes.append(_indexed(one.inner, body, at, out))
            continue
        skip = skip and one.opcode == files.MESSAGE_INDEX
        if one.opcode == files.DATA_END and log.fix_outer and len(one.content) == 4:
            stated = zlib.crc32(out) if any(one.content) else 0
            out += Record(one.opcode, struct.pack("<I", stated), one.length).raw()
            continue
        out += one.raw()
    start = len(out)
    summary = b"".join(
        indexes.pop(0) if r.opcode == files.CHUNK_INDEX and log.fix_index and indexes else r.raw()
        for r in log.summary
    )
    footer = log.footer.content
    if log.fix_outer and footer[:8] == _taken_apart(log.base).footer.content[:8]:
        footer = struct.pack("<QQ", start if summary else 0, 0) + footer[16:]
    head = Record(log.footer.opcode, footer, log.footer.length).raw()
    if log.fix_outer and len(footer) == 20 and any(footer[16:]):
        head = head[:-4] + struct.pack("<I", zlib.crc32(summary + head[:-4]))
    return bytes(out) + summary + head + files.MAGIC


def _packed(one: Record, fix_crc: bool) -> bytes:
    """The content of a chunk whose records were changed."""
    assert one.inner is not None
    times, _, name, _ = _chunk_parts(one.content)
    raw = b"".join(r.raw() for r in one.inner)
    crc = one.content[24:28]
    if fix_crc and any(crc):
        crc = struct.pack("<I", zlib.crc32(raw))
    stored = files.compress(raw, name)
    return (
        times
        + struct.pack("<Q", len(raw))
        + crc
        + files.text(name)
        + struct.pack("<Q", len(stored))
        + stored
    )


def _indexed(inner: list[Record], body: bytes, at: int, out: bytearray) -> bytes:
    """Add a chunk's message indexes behind it; gives its chunk index record."""
    pairs: dict[int, bytes] = {}
    place = 0
    for one in inner:
        if one.opcode == files.MESSAGE and len(one.content) >= 22:
            channel, _, time = struct.unpack_from("<HIQ", one.content)
            pairs[channel] = pairs.get(channel, b"") + struct.pack("<QQ", time, place)
        place += 9 + len(one.content)
    length, index_at = len(out) - at, len(out)
    offsets = b""
    for channel, raw in pairs.items():
        offsets += struct.pack("<HQ", channel, len(out))
        out += files.record(files.MESSAGE_INDEX, struct.pack("<HI", channel, len(raw)) + raw)
    content = body[:16] + struct.pack("<QQI", at, length, len(offsets)) + offsets
    content += struct.pack("<Q", len(out) - index_at) + body[28:32]
    return files.record(files.CHUNK_INDEX, content + bytes(16))


# What is changed


def _place(random: Random, log: _Log) -> list[Record]:
    """The records among which something is changed: data, summary or those of a chunk."""
    chunks = [r.inner for r in log.data if r.inner]
    where = random.choice(("data", "summary", "chunk", "chunk"))
    if where == "chunk" and chunks:
        log.inner_changed = True
        return random.choice(chunks)
    return log.summary if where == "summary" and log.summary else log.data


def _number(random: Random, width: int, before: int) -> int:
    """A number that is wrong in a way that matters."""
    big = 1 << 8 * width
    near = (before + 1, before - 1, before * 2, random.randrange(256), random.randrange(big))
    far = (0, 1, 2, big - 1, big >> 1, (big >> 1) - 1, 2**28, 2**31, 2**32 - 1, 2**40, 2**62)
    wrong = random.choice((*near, *far))
    return wrong % big


def _field(random: Random, log: _Log) -> None:
    """Change a field of a record."""
    records = [*_place(random, log), log.footer]
    one = random.choice([r for r in records if r.opcode in _FIELDS] or [log.footer])
    at, width = random.choice(_FIELDS[one.opcode][1])
    content = bytearray(one.content)
    if at < 0:
        at += len(content)
    if 0 <= at <= len(content) - width:
        before = int.from_bytes(content[at : at + width], "little")
        content[at : at + width] = _number(random, width, before).to_bytes(width, "little")
    one.content = bytes(content)


def _length(random: Random, log: _Log) -> None:
    """Let a record lie about its length."""
    one = random.choice([*_place(random, log), log.footer])
    one.length = _number(random, 8, len(one.content))


def _content(random: Random, log: _Log) -> None:
    """Cut a record's content, lengthen it, or change bytes of it."""
    one = random.choice(_place(random, log))
    content, at = bytearray(one.content), random.randrange(len(one.content) + 1)
    match random.randrange(4):
        case 0:
            del content[at:]
        case 1:
            content += random.randbytes(random.randrange(1, 30))
        case 2:
            content[at : at + 4] = random.randbytes(4)
        case 3:
            content[at : at + 4] = random.choice((bytes(4), b"\xff" * 4, b"\xff\xfe\xfd\xfc"))
    one.content = bytes(content)


def _opcode(random: Random, log: _Log) -> None:
    random.choice(_place(random, log)).opcode = random.choice((*range(17), 127, 128, 255))


def _delete(random: Random, log: _Log) -> None:
    records = _place(random, log)
    if len(records) > 1:
        del records[random.randrange(len(records))]


def _repeat(random: Random, log: _Log) -> None:
    """Put a copy of a record somewhere, perhaps where it has no place."""
    one = _copied([random.choice(_place(random, log))])[0]
    target = _place(random, log)
    target.insert(random.randrange(len(target) + 1), one)


def _swap(random: Random, log: _Log) -> None:
    records = _place(random, log)
    i, j = random.randrange(len(records)), random.randrange(len(records))
    records[i], records[j] = records[j], records[i]


def _insert(random: Random, log: _Log) -> None:
    """Put in a record that other writers may write, or that makes no sense."""
    target = _place(random, log)
    one = random.choice(
        (
            Record(0x80, b"private"),
            Record(files.SCHEMA, files.schema(random.randrange(4))),
            Record(files.CHANNEL, files.channel(random.randrange(4), random.randrange(3), "/a")),
            Record(files.MESSAGE, files.message(random.randrange(4), 0, 5, 5, b"x")),
            Record(files.METADATA, files.text("m") + files.texts({"a": "b"})),
            Record(files.HEADER, files.text("") * 2),
            Record(files.DATA_END, bytes(4)),
            Record(files.FOOTER, bytes(20)),
            Record(files.MESSAGE_INDEX, struct.pack("<HI", 1, 0)),
            Record(0, b""),
        )
    )
    target.insert(random.randrange(len(target) + 1), one)


def _chunk(random: Random, log: _Log) -> None:
    """Change how a chunk is stored, its records left as they are."""
    chunks = [r for r in log.data if r.inner is not None]
    if not chunks:
        return
    one = random.choice(chunks)
    one.inner = None
    try:
        times, size, name, stored = _chunk_parts(one.content)
    except (struct.error, UnicodeDecodeError):
        return
    crc = one.content[24:28]
    at = random.randrange(len(stored) + 1)
    match random.randrange(6):
        case 0:
            name = random.choice(("", "lz4", "zstd", "brotli", "ZSTD", "zstd\0", "x" * 300))
        case 1:
            stored = stored[:at]
        case 2:
            stored = stored[:at] + random.randbytes(3) + stored[at + 3 :]
        case 3:
            stored = stored + random.choice((stored, b"\0" * 9, random.randbytes(9)))
        case 4:
            size = _number(random, 8, size)
        case 5:
            crc = random.choice((bytes(4), random.randbytes(4)))
    length = random.choice((len(stored),) * 4 + (_number(random, 8, len(stored)),))
    one.content = (
        times
        + struct.pack("<Q", size)
        + crc
        + files.text(name)
        + struct.pack("<Q", length)
        + stored
    )


def _text(random: Random, log: _Log) -> None:
    """Change a text of a definition or of metadata."""
    records = [r for r in _place(random, log) if r.opcode in (3, 4, 12, 9)]
    if records:
        one = random.choice(records)
        for old in (b"left", b"/view", b"48", b"2x3", b"50.0", b"uint8", b"x,y", b"protobuf"):
            if old in one.content and random.random() < 0.5:
                new = random.choice(
                    (b"\xff" * len(old), b"0" * len(old), b"9" * len(old), b"-" * len(old))
                )
                one.content = one.content.replace(old, new)


_CHANGES: dict[Callable[[Random, _Log], None], int] = {
    _field: 6,
    _length: 2,
    _content: 3,
    _opcode: 1,
    _delete: 2,
    _repeat: 2,
    _swap: 1,
    _insert: 2,
    _chunk: 3,
    _text: 2,
}
_KINDS, _WEIGHTS = list(_CHANGES), list(_CHANGES.values())


def _bytes_changed(random: Random, whole: bytes) -> bytes:
    """A file changed without regard to what its bytes mean."""
    raw = bytearray(whole)
    for _ in range(random.choice((1, 1, 2, 4))):
        if raw:
            random.choice(BYTES)(random, raw)
    return bytes(raw)
