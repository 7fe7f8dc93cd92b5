"""Break MCAP logs: take files apart into records, change them and put them together again.

Fields, lengths, offsets, names and whole records are changed, within chunks and outside them;
checksums and indexes are made right again afterwards, or not. The same number gives the same file.
"""

from __future__ import annotations

import contextlib
import struct
import tempfile
import zlib
from collections.abc import Callable
from copy import deepcopy
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
    files.CHANNEL: [(0, 2), (2, 2), (4, 4)],
    files.SCHEMA: [(0, 2), (2, 4)],
    files.MESSAGE: [(0, 2), (2, 4), (6, 8), (14, 8)],
    files.CHUNK: [(0, 8), (8, 8), (16, 8), (24, 4), (28, 4)],
    files.MESSAGE_INDEX: [(0, 2), (2, 4), (6, 8), (14, 8)],
    files.CHUNK_INDEX: [(0, 8), (8, 8), (16, 8), (24, 8), (32, 4), (36, 2)],
    files.ATTACHMENT: [(0, 8), (8, 8), (16, 4), (-4, 4)],
    files.STATISTICS: [(0, 8), (8, 2), (10, 4), (14, 4), (18, 4), (22, 4), (42, 4)],
    files.METADATA: [(0, 4)],
    files.DATA_END: [(0, 4)],
    files.FOOTER: [(0, 8), (8, 8), (16, 4)],
    files.HEADER: [(0, 4)],
    files.SUMMARY_OFFSET: [(0, 1), (1, 8), (9, 8)],
}


@dataclass(slots=True)
class Record:
    """A record; `length` where it states a wrong one, `inner` for the records of a chunk."""

    opcode: int
    content: bytes
    length: int | None = None
    inner: list[Record] | None = None

    def raw(self) -> bytes:
        """Return its bytes."""
        length = len(self.content) if self.length is None else self.length
        return HEADER.pack(self.opcode & 0xFF, length & (2**64 - 1)) + self.content


@dataclass(slots=True)
class Case:
    """A broken log.

    Attributes:
        raw: the file.
        base: name of the log it was made from.
        trusted: whether no checksum was made right again.
    """

    raw: bytes
    base: str
    trusted: bool


@dataclass(slots=True)
class _Log:
    """A log taken apart: records up to the data end, those of the summary, the footer."""

    base: str
    data: list[Record]
    summary: list[Record]
    footer: Record
    fix_outer: bool = False
    fix_chunks: bool = False
    fix_index: bool = False
    inner_changed: bool = False


def _recording(compression: str, folder: Path) -> bytes:
    spec = SourceSpec(("left",), SHAPE, "uint8", TRUTH, 50.0, 10**9)
    settings = RecordConfig(compression=compression, chunk_size=1024)  # type: ignore[arg-type]
    log = ViewLog(folder, "left", RecordingSpec("fuzz", 0, spec, {}), settings)
    pixels = (17 * np.arange(FRAMES)[:, None] + 5 * np.arange(6) + 1) % 256
    truth = np.arange(FRAMES * 2, dtype=np.float64).reshape(FRAMES, 2)
    log.write(Block(0, 0, pixels.astype(np.uint8).reshape(FRAMES, *SHAPE), truth))
    log.finish()
    return (folder / "left.mcap").read_bytes()


@cache
def bases() -> dict[str, bytes]:
    """Return valid logs of every layout, by name; each "recording" can be learned from."""
    result: dict[str, bytes] = {}
    for name in ("zstd", "lz4", "none"):
        with tempfile.TemporaryDirectory() as folder:
            result[f"recording {name}"] = _recording(name, Path(folder))
    others: dict[str, dict[str, Any]] = {
        "chunks zstd": {"compression": CompressionType.ZSTD, "enable_data_crcs": True},
        "chunks none": {"compression": CompressionType.NONE, "enable_data_crcs": True},
        "no index": {"index_types": IndexType.NONE, "use_statistics": False},
        "no repetition": {"repeat_channels": False, "repeat_schemas": False},
        "no checksums": {"enable_crcs": False},
        "no chunks": {"use_chunking": False, "enable_data_crcs": True},
    }
    for name, options in others.items():
        times = (7 * i % 20 for i in range(FRAMES))
        result[name] = files.written(times, lambda i: bytes([i]) * (9 + i % 7), 180, **options)
    return result


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
    result = []
    while at < stop:
        opcode, length = HEADER.unpack_from(raw, at)
        result.append(Record(opcode, raw[at + 9 : at + 9 + length]))
        at += 9 + length
    return result


def _chunk_parts(content: bytes) -> tuple[bytes, int, str, bytes]:
    """Return times, size, compression and stored bytes of a chunk."""
    size, _, length = struct.unpack_from("<QII", content, 16)
    name = content[32 : 32 + length].decode()
    return content[:16], size, name, content[40 + length :]


def _inner(content: bytes) -> list[Record]:
    from recorder.mcap.chunks import decompressed

    _, size, name, stored = _chunk_parts(content)
    records = decompressed(np.frombuffer(stored, np.uint8), name, size)
    return _records(records.tobytes(), 0, size)


def mutated(number: int) -> Case:
    """Return the broken log with a number."""
    random = Random(number)
    base = random.choice(list(bases()))
    if random.random() < 0.2:
        return Case(_bytes_changed(random, bases()[base]), base, trusted=True)
    log = deepcopy(_taken_apart(base))
    log.fix_outer = random.random() < 0.8
    log.fix_chunks = log.fix_outer and random.random() < 0.8
    log.fix_index = log.fix_outer and random.random() < 0.6
    for _ in range(random.choice((1, 1, 1, 2, 2, 3, 5))):
        random.choices(list(_CHANGES), list(_CHANGES.values()))[0](random, log)
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
    """Return the content of a chunk whose records were changed."""
    assert one.inner is not None
    times, _, name, _ = _chunk_parts(one.content)
    raw = b"".join(r.raw() for r in one.inner)
    crc = one.content[24:28]
    if fix_crc and any(crc):
        crc = struct.pack("<I", zlib.crc32(raw))
    stored = files.compress(raw, name)
    return _chunk_of(times, len(raw), crc, name, len(stored), stored)


def _chunk_of(times: bytes, size: int, crc: bytes, name: str, length: int, stored: bytes) -> bytes:
    head = times + struct.pack("<Q", size) + crc + files.text(name)
    return head + struct.pack("<Q", length) + stored


def _indexed(inner: list[Record], body: bytes, at: int, out: bytearray) -> bytes:
    """Append a chunk's message indexes; return its chunk index record."""
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


# Changes


def _place(random: Random, log: _Log) -> list[Record]:
    """Choose records to change: data, summary or those of a chunk."""
    chunks = [r.inner for r in log.data if r.inner]
    where = random.choice(("data", "summary", "chunk", "chunk"))
    if where == "chunk" and chunks:
        log.inner_changed = True
        return random.choice(chunks)
    return log.summary if where == "summary" and log.summary else log.data


def _number(random: Random, width: int, before: int) -> int:
    """Return a wrong number, near the right one or far from it."""
    big = 1 << 8 * width
    near = (before + 1, before - 1, before * 2, random.randrange(256), random.randrange(big))
    far = (0, 1, 2, big - 1, big >> 1, (big >> 1) - 1, 2**28, 2**31, 2**32 - 1, 2**40, 2**62)
    wrong = random.choice((*near, *far))
    return wrong % big


def _field(random: Random, log: _Log) -> None:
    """Change a field of a record."""
    records = [*_place(random, log), log.footer]
    one = random.choice([r for r in records if r.opcode in _FIELDS] or [log.footer])
    at, width = random.choice(_FIELDS[one.opcode])
    content = bytearray(one.content)
    if at < 0:
        at += len(content)
    if 0 <= at <= len(content) - width:
        before = int.from_bytes(content[at : at + width], "little")
        content[at : at + width] = _number(random, width, before).to_bytes(width, "little")
    one.content = bytes(content)


def _length(random: Random, log: _Log) -> None:
    """Let a record state a wrong length."""
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
    """Insert a copy of a record somewhere."""
    one = deepcopy(random.choice(_place(random, log)))
    target = _place(random, log)
    target.insert(random.randrange(len(target) + 1), one)


def _insert(random: Random, log: _Log) -> None:
    """Insert a record that other writers may write, or that makes no sense."""
    target = _place(random, log)
    one = random.choice(
        (
            Record(0x80, b"private"),
            Record(files.SCHEMA, files.schema(random.randrange(4))),
            Record(files.CHANNEL, files.channel(random.randrange(4), random.randrange(3), "/a")),
            Record(files.MESSAGE, files.message(random.randrange(4), 0, 5, 5, b"x")),
            Record(files.METADATA, files.text("m") + files.texts({"a": "b"})),
            Record(files.FOOTER, bytes(20)),
        )
    )
    target.insert(random.randrange(len(target) + 1), one)


def _chunk(random: Random, log: _Log) -> None:
    """Change how a chunk is stored, not its records."""
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
    one.content = _chunk_of(times, size, crc, name, length, stored)


_CHANGES: dict[Callable[[Random, _Log], None], int] = {
    _field: 6,
    _length: 2,
    _content: 3,
    _opcode: 1,
    _delete: 2,
    _repeat: 2,
    _insert: 2,
    _chunk: 3,
}
"""What changes a log, with how often it does."""


def _bytes_changed(random: Random, whole: bytes) -> bytes:
    """Change a file without regard to what its bytes mean."""
    raw = bytearray(whole)
    for _ in range(random.choice((1, 1, 2, 4))):
        if raw:
            random.choice(BYTES)(random, raw)
    return bytes(raw)
