"""Damaged, cut and hostile logs: no changed byte passes, nothing else than our error escapes."""

from __future__ import annotations

import contextlib
import os
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mcap_files as files
import pytest
from mcap.writer import CompressionType, IndexType

from cdmisfa.core.errors import LogDamagedError
from recorder.mcap.reader import LogReader
from replay.open_sources import open_recording

MESSAGES = 40


def payload(i: int) -> bytes:
    return bytes([i]) * (30 + i % 7)


def log(compression: CompressionType = CompressionType.ZSTD, **options: Any) -> bytes:
    return files.written(range(MESSAGES), payload, 400, compression=compression, **options)


KINDS: dict[str, bytes] = {
    "zstd": log(),
    "lz4": log(CompressionType.LZ4),
    "none": log(CompressionType.NONE, enable_data_crcs=True),
    "without index": log(
        index_types=IndexType.NONE, use_statistics=False, use_summary_offsets=False
    ),
    "without chunks": log(use_chunking=False, enable_data_crcs=True),
}


def read_all(path: Path, *, skip_damaged: bool = False) -> list[tuple[str, int, bytes]]:
    with LogReader(path, skip_damaged=skip_damaged) as reader:
        for attachment in reader.attachments:
            reader.attachment_data(attachment)
        return [(m.channel.topic, m.log_time, m.data) for m in reader.messages()]


TRUE = {("/ab"[0] + "ab"[i % 2], i, payload(i)) for i in range(MESSAGES)}


@pytest.mark.parametrize("kind", KINDS)
def test_a_flipped_bit_is_never_believed(tmp_path: Path, kind: str) -> None:
    raw, path = KINDS[kind], tmp_path / "log.mcap"
    reported = 0
    for at in range(0, len(raw), 13):
        path.write_bytes(raw[:at] + bytes([raw[at] ^ 1 << at % 8]) + raw[at + 1 :])
        try:
            result = read_all(path)
        except LogDamagedError as error:
            reported += str(error).startswith(f"{path}: ")
            continue
        with LogReader(path) as reader:
            whole = reader.complete
        assert {(t, d) for _, t, d in result} <= {(t, d) for _, t, d in TRUE}
        assert len(result) == MESSAGES or not whole
    assert reported > len(raw) / 26


@pytest.mark.parametrize("kind", KINDS)
def test_a_cut_leaves_everything_before_it(tmp_path: Path, kind: str) -> None:
    raw, path = KINDS[kind], tmp_path / "log.mcap"
    path.write_bytes(raw)
    with LogReader(path) as reader:
        ends = [
            (s.data_offset + s.stored, sum((s.channel_counts() or {}).values()))
            for s in reader.segments
        ]
    expected_when_known = kind not in ("without index", "without chunks")
    before = 0
    for size in range(8, len(raw), 19):
        path.write_bytes(raw[:size])
        with LogReader(path) as reader:
            result = [(m.channel.topic, m.log_time, m.data) for m in reader.messages()]
            assert not reader.complete
            assert reader.missing
        assert result == sorted(TRUE, key=lambda m: m[1])[: len(result)]
        assert len(result) >= before
        before = len(result)
        if expected_when_known:
            assert len(result) == sum(count for end, count in ends if end <= size)
    assert before == MESSAGES


def test_part_of_a_cut_chunk_is_read_when_asked(tmp_path: Path) -> None:
    raw, path = KINDS["none"], tmp_path / "log.mcap"
    path.write_bytes(raw)
    with LogReader(path) as reader:
        last = reader.segments[-1]
    path.write_bytes(raw[: last.data_offset + last.stored - 10])
    whole, skipping = read_all(path), read_all(path, skip_damaged=True)
    assert len(whole) < len(skipping) < MESSAGES


@pytest.mark.parametrize("compression", ["", "lz4", "zstd"])
def test_a_chunk_still_open_when_the_writer_died_is_read(tmp_path: Path, compression: str) -> None:
    """Some writers stream into a chunk whose lengths are filled in at its end."""
    messages = [
        files.record(files.MESSAGE, files.message(1, i, i, i, os.urandom(5000))) for i in range(90)
    ]
    whole = files.chunk(body(*messages[:60]), 0, 59, compression=compression)
    stored = files.compress(b"".join(messages[60:]), compression)
    still_open = struct.pack("<BQQQQI", files.CHUNK, 2**64 - 1, 0, 0, 0, 0)
    still_open += (
        files.text(compression) + struct.pack("<Q", 2**64 - 1) + stored[: len(stored) - 99]
    )
    path = tmp_path / "log.mcap"
    path.write_bytes(files.MAGIC + files.header() + whole + still_open)
    times = [time for _, time, _ in read_all(path)]
    assert times == list(range(len(times)))
    assert 60 < len(times) < 90


def one_chunk(made: bytes) -> bytes:
    return files.finish(files.MAGIC + files.header() + made, crc=False)


def body(*records: bytes) -> bytes:
    start = files.record(files.CHANNEL, files.channel(schema_id=0))
    return start + b"".join(records)


GOOD = files.record(files.MESSAGE, files.message(1, 0, 5, 5, b"x"))
HOSTILE: dict[str, Callable[[], bytes]] = {
    "unknown compression": lambda: files.chunk(body(GOOD), 5, 5, compression="brotli"),
    "size lies small": lambda: files.chunk(body(GOOD), 5, 5, compression="zstd", size=10),
    "size lies large": lambda: files.chunk(body(GOOD), 5, 5, compression="zstd", size=10**6),
    "size lies huge": lambda: files.chunk(body(GOOD), 5, 5, compression="lz4", size=2**40),
    "lz4 lies": lambda: files.chunk(body(GOOD), 5, 5, compression="lz4", size=99),
    "message too short": lambda: files.chunk(body(files.record(files.MESSAGE, b"abc")), 5, 5),
    "message overruns": lambda: files.chunk(body(GOOD[:1] + b"\xff" * 8 + GOOD[9:]), 5, 5),
    "chunk in chunk": lambda: files.chunk(body(files.chunk(GOOD, 5, 5)), 5, 5),
    "garbage in chunk": lambda: files.chunk(body(GOOD, bytes(50)), 5, 5),
    "unknown channel": lambda: files.chunk(GOOD, 5, 5),
    "unknown schema": lambda: files.chunk(
        files.record(files.CHANNEL, files.channel(schema_id=3)) + GOOD, 5, 5
    ),
    "times lie": lambda: files.chunk(body(GOOD), 6, 9),
    "channel twice": lambda: files.chunk(
        body(files.record(files.CHANNEL, files.channel(schema_id=0, topic="other")), GOOD), 5, 5
    ),
    "schema twice": lambda: (
        files.record(files.SCHEMA, files.schema())
        + files.record(files.SCHEMA, files.schema(name="Other"))
    ),
    "not UTF-8": lambda: files.record(files.SCHEMA, b"\1\0\2\0\0\0\xff\xff\0\0\0\0\0\0\0\0"),
    "text of 4 GiB": lambda: files.record(files.SCHEMA, b"\1\0\xff\xff\xff\xff"),
    "attachment of 2**40 bytes": lambda: files.record(
        files.ATTACHMENT, bytes(16) + files.text("a") * 2 + struct.pack("<QI", 2**40, 0)
    ),
    "record of 2**60 bytes": lambda: struct.pack("<BQ", files.METADATA, 2**60),
    "index without chunk": lambda: files.record(files.MESSAGE_INDEX, bytes(6)),
    "index of 4 GiB": lambda: (
        files.chunk(body(GOOD), 5, 5) + files.record(files.MESSAGE_INDEX, b"\1\0\xff\xff\xff\xff")
    ),
    "statistics among the data": lambda: files.record(files.STATISTICS, bytes(46)),
    "second header": files.header,
    "opcode 0": lambda: files.record(0, b""),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_lying_file_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / "log.mcap"
    path.write_bytes(one_chunk(HOSTILE[name]()))
    with pytest.raises(LogDamagedError, match=r"log\.mcap"):
        read_all(path)
    assert len(read_all(path, skip_damaged=True)) <= 1


@pytest.mark.parametrize("places", [[(5, 0)], [(5, 2**50)], [(6, 42)], [(5, 42), (5, 42)], []])
def test_a_lying_message_index_is_not_used(tmp_path: Path, places: list[tuple[int, int]]) -> None:
    made = body(GOOD, GOOD)
    pairs = b"".join(struct.pack("<QQ", *pair) for pair in places)
    index = files.record(files.MESSAGE_INDEX, struct.pack("<HI", 1, len(pairs)) + pairs)
    path = tmp_path / "log.mcap"
    path.write_bytes(one_chunk(files.chunk(made, 5, 5) + index))
    with LogReader(path, check="data") as reader:
        assert [m.data for m in reader.messages()] == [b"x", b"x"]
        assert reader.problems


def test_a_summary_that_lies_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    data = files.MAGIC + files.header() + files.chunk(body(GOOD), 5, 5)
    index = files.record(files.CHUNK_INDEX, struct.pack("<QQQ", 5, 5, 9999))
    path.write_bytes(files.finish(data, index))
    with pytest.raises(LogDamagedError, match="summary"):
        read_all(path)
    assert len(read_all(path, skip_damaged=True)) == 1


@pytest.mark.parametrize("share", [0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99])
def test_a_recording_cut_off_while_it_is_read_is_damage(
    tmp_path: Path, oscillatory_recording: Path, share: float
) -> None:
    copy = Path(shutil.copytree(oscillatory_recording, tmp_path / "copy"))
    with open_recording(sorted(copy.glob("*.mcap"))) as source:
        source.take(0, 40)
        os.truncate(copy / "x1.mcap", int(share * (copy / "x1.mcap").stat().st_size))
        with contextlib.suppress(LogDamagedError):
            while source.t < 2000:
                source.take(0, 40)
