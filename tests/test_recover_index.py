"""Flips outside the chunks' own data cost no message, and `recover` says so."""

from __future__ import annotations

import io
import shutil
from collections.abc import Iterator
from pathlib import Path
from random import Random

import pytest
from conftest import Cdmisfa
from mcap.writer import CompressionType, Writer

from recorder.mcap.reader import LogReader
from recorder.mcap.records import Segment
from replay.integrity.recover import recover_log

MESSAGES = 60
CRC = range(33, 37)
"""Where a chunk states its CRC, from its first byte on."""


def log(compression: CompressionType = CompressionType.ZSTD) -> bytes:
    stream = io.BytesIO()
    writer = Writer(stream, compression=compression, chunk_size=700, enable_data_crcs=True)
    writer.start(profile="p", library="l")
    schema = writer.register_schema("name", "encoding", b"data")
    channels = [writer.register_channel(topic, "raw", schema) for topic in ("/a", "/b", "/c")]
    writer.add_metadata("meta", {"key": "value"})
    for i in range(MESSAGES):
        writer.add_message(channels[i % 3], i, bytes([i]) * (30 + i % 7), i, i)
    writer.finish()
    return stream.getvalue()


LOGS = {name: log(CompressionType[name]) for name in ("ZSTD", "LZ4", "NONE")}


def messages(path: Path) -> list[tuple[str, int, bytes]]:
    with LogReader(path) as reader:
        return [(m.channel.topic, m.log_time, m.data) for m in reader.messages()]


def chunks(raw: bytes, path: Path) -> list[Segment]:
    path.write_bytes(raw)
    with LogReader(path) as reader:
        assert len(reader.segments) > 4
        return reader.segments


def flipped(raw: bytes, *bits: int) -> bytes:
    changed = bytearray(raw)
    for bit in bits:
        changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


def head(chunk: Segment) -> Iterator[int]:
    """The bytes of a chunk before its records, without its CRC, which nothing else states."""
    offsets = range(chunk.data_offset - chunk.offset)
    return (chunk.offset + at for at in offsets if at not in CRC)


def between(segments: list[Segment]) -> list[int]:
    """The bytes of all message indexes and heads of chunks."""
    indexes = (at for c in segments for at in range(c.data_offset + c.stored, c.stop))
    return [*indexes, *(at for c in segments for at in head(c))]


@pytest.mark.parametrize("kind", LOGS)
def test_what_stands_twice_is_made_again(tmp_path: Path, kind: str) -> None:
    raw, path, out = LOGS[kind], tmp_path / "log.mcap", tmp_path / "out.mcap"
    places, true = between(chunks(raw, path)), messages(path)
    rng = Random(kind)
    for number in range(40):
        bits = [8 * rng.choice(places) + rng.randrange(8) for _ in range(1 + number % 3)]
        path.write_bytes(flipped(raw, *bits))
        result = recover_log(path, out, force=True)
        assert (messages(out), result.lost) == (true, ()), bits
        assert result.mended or len(set(bits)) < len(bits), bits
        assert [channel.lost for channel in result.channels] == [0, 0, 0]


@pytest.mark.parametrize("kind", LOGS)
def test_no_message_is_lost_where_the_summary_is_damaged_too(tmp_path: Path, kind: str) -> None:
    raw, path, out = LOGS[kind], tmp_path / "log.mcap", tmp_path / "out.mcap"
    segments, true = chunks(raw, path), messages(path)
    with LogReader(path) as reader:
        end = reader.data_end + 13
    indexes = [at for c in segments for at in range(c.data_offset + c.stored, c.stop)]
    rng = Random(kind)
    for number in range(40):
        bits = [8 * rng.choice(indexes) + rng.randrange(8) for _ in range(number % 2)]
        broken = flipped(raw, *bits, 8 * rng.randrange(end, len(raw)) + rng.randrange(8))
        path.write_bytes((broken, raw[: rng.randrange(end, len(raw))])[number % 5 == 4])
        result = recover_log(path, out, force=True)
        assert (messages(out), result.lost) == (true, ()), bits


def test_a_damaged_chunk_costs_itself_whatever_else_is_damaged(tmp_path: Path) -> None:
    raw, path, out = LOGS["LZ4"], tmp_path / "log.mcap", tmp_path / "out.mcap"
    segments, true = chunks(raw, path), messages(path)
    places, rng = between(segments), Random(1)
    for chunk in segments:
        bits = [8 * rng.choice(places) + rng.randrange(8) for _ in range(4)]
        path.write_bytes(flipped(raw, *bits, 8 * (chunk.data_offset + chunk.stored // 2)))
        result = recover_log(path, out, force=True)
        assert messages(out) == [m for m in true if not chunk.start <= m[1] <= chunk.end]
        assert any(chunk.name in problem.where for problem in result.lost)
        assert sum(c.lost or 0 for c in result.channels) == MESSAGES - len(messages(out))


def intact_end(reader: LogReader) -> int:
    """Return a place in the first chunk."""
    return reader.segments[0].data_offset + 300


@pytest.mark.parametrize("seed", range(4))
def test_a_recovered_file_is_whole_and_has_all_messages_outside_the_damage(
    cdmisfa: Cdmisfa,
    tmp_path: Path,
    oscillatory_recording: Path,
    oscillatory_run: Path,
    seed: int,
) -> None:
    random = Random(seed)
    for original in (oscillatory_recording / "x2.mcap", oscillatory_run / "run.mcap"):
        folder, out = tmp_path / original.stem, tmp_path / f"{original.stem} recovered"
        raw = (file := shutil.copytree(original.parent, folder) / original.name).read_bytes()
        with LogReader(original) as reader:
            place = random.randrange(reader.segments[0].stop, reader.data_end)
            intact = [s for s in reader.segments if s.stop <= place]
            damaged, later = raw[:place], []
            if seed == 0:  # bytes are missing in the chunk with the definitions: all offsets change
                intact, later = [], reader.segments[1:]
                damaged = raw[: intact_end(reader)] + raw[intact_end(reader) + 100 :]
            elif seed % 2:
                damaged = flipped(raw, 8 * place + random.randrange(8))
                later = [s for s in reader.segments if s.offset > place]
            tables = [reader.table(segment) for segment in (*intact, *later)]
        least = sum(len(table) for table in tables if table is not None)
        file.write_bytes(damaged)
        assert cdmisfa("verify", folder).code == 3
        assert cdmisfa("recover", folder, "-o", out).code in (0, 3)
        assert cdmisfa("verify", out / original.name).code == 0
        assert cdmisfa("verify", out).code == 0
        saved, every = messages(out / original.name), messages(original)
        assert len(saved) >= least
        assert not set(saved) - set(every)
        if original.parent == oscillatory_recording:
            assert cdmisfa("learn", out, "--max-iterations", 5).code == 0


def test_a_view_without_a_readable_chunk_is_damage(
    cdmisfa: Cdmisfa, tmp_path: Path, oscillatory_recording: Path
) -> None:
    folder = shutil.copytree(oscillatory_recording, tmp_path / "rec")
    file = folder / "x1.mcap"
    with LogReader(file) as reader:
        places = [8 * (chunk.data_offset + chunk.stored // 2) for chunk in reader.segments]
    file.write_bytes(flipped(file.read_bytes(), *places))
    for log in (folder, file):
        done = cdmisfa("verify", log)
        assert (done.code, done.out.count("its CRC does not match") > 30) == (3, True)


def test_a_log_that_ends_before_its_first_message_gives_no_file(
    cdmisfa: Cdmisfa, tmp_path: Path, oscillatory_recording: Path
) -> None:
    with LogReader(oscillatory_recording / "x1.mcap") as reader:
        end = reader.segments[0].offset
    folder = tmp_path / "recording"
    folder.mkdir()
    for name, size in (("x1.mcap", end), ("x2.mcap", end + 5), ("x3.mcap", 30)):
        (folder / name).write_bytes((oscillatory_recording / name).read_bytes()[:size])
        done = cdmisfa("recover", folder / name, "-o", tmp_path / name)
        assert (done.code, "no message can be recovered" in done.err) == (3, True)
        assert not list(tmp_path.glob("*.mcap*"))
    assert cdmisfa("recover", folder, "-o", tmp_path / "out").code == 3
    shutil.copy(oscillatory_recording / "x2.mcap", folder)
    assert cdmisfa("recover", folder, "-o", tmp_path / "out").code == 3
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["x2.mcap"]
