"""Chunks that are decompressed ahead, in memory that is used again, and indexes read together."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer

from cdmisfa.core.errors import LogDamagedError
from recorder.mcap import summary
from recorder.mcap.compression import Decompressor
from recorder.mcap.reader import LogReader
from recorder.mcap.records import RECORD_HEADER, MalformedRecord
from recorder.mcap.store import FileStore, Store


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
def test_chunks_that_are_held_stay_as_they_are_while_others_are_decoded_ahead(
    tmp_path: Path, compression: CompressionType
) -> None:
    path = tmp_path / "log.mcap"
    random = np.random.default_rng(1)
    payloads = [random.integers(0, 9, 3000, np.uint8).tobytes() for _ in range(60)]
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=8192, compression=compression)
        writer.start()
        channel = writer.register_channel("a", "b", 0)
        for i, payload in enumerate(payloads):
            writer.add_message(channel, i, payload, i)
        writer.finish()
    with LogReader(path, cache_bytes=1) as reader:
        held = [table for _, table in reader.tables()]
        assert len(held) == 20
        found = [table.payload(row) for table in held for row in range(len(table))]
        assert found == payloads
        for number in (7, 3, 4, 5, 6, 19, 0, 1, 2):
            table = reader.table(reader.segments[number])
            assert table is not None
            assert [table.payload(row) for row in range(3)] == payloads[3 * number : 3 * number + 3]


@pytest.mark.parametrize("number", [0, 5, 19])
@pytest.mark.parametrize("compression", [CompressionType.LZ4, CompressionType.NONE])
def test_a_damaged_chunk_is_refused_where_it_is_decoded_ahead(
    tmp_path: Path, number: int, compression: CompressionType
) -> None:
    path = tmp_path / "log.mcap"
    random = np.random.default_rng(number)
    noise = [random.integers(0, 256, 100, np.uint8).tobytes() for _ in range(20)]
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1000, compression=compression)
        writer.start()
        channel = writer.register_channel("a", "b", 0)
        for i in range(20):
            writer.add_message(channel, i, noise[i] + bytes(900), i)
        writer.finish()
    raw = bytearray(path.read_bytes())
    raw[raw.index(noise[number])] ^= 1
    path.write_bytes(raw)
    with LogReader(path) as reader:
        messages = reader.messages()
        assert [next(messages).log_time for _ in range(number)] == list(range(number))
        with pytest.raises(LogDamagedError, match="its CRC does not match"):
            next(messages)


@pytest.mark.parametrize(
    ("compression", "most", "ahead"),
    [
        (CompressionType.ZSTD, 9, True),
        (CompressionType.LZ4, 2, True),
        (CompressionType.ZSTD, 256, False),
        (CompressionType.NONE, 2, False),
    ],
)
def test_only_what_is_compressed_is_read_by_other_threads(
    tmp_path: Path, compression: CompressionType, most: int, ahead: bool
) -> None:
    path = tmp_path / "log.mcap"
    random = np.random.default_rng(1)
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=4000, compression=compression)
        writer.start()
        channel = writer.register_channel("a", "b", 0)
        for i in range(8):
            writer.add_message(channel, i, random.integers(0, most, 5000, np.uint8).tobytes(), i)
        writer.finish()
    with LogReader(path) as reader:
        assert len(list(reader.messages())) == len(reader.segments) == 8
        assert (reader._chunks._threads is not None) == ahead


class Held(Store):
    """Bytes in memory."""

    def __init__(self, data: bytes) -> None:
        super().__init__(Path("held.mcap"))
        self._data, self.size = data, len(data)

    def read_at(self, offset: int, count: int) -> bytes:
        return self._data[offset : offset + count]

    def close(self) -> None:
        """Nothing."""


def chunk_indexes(topics: str) -> tuple[bytes, int]:
    """The chunk indexes of a log as they stand in its summary, and the length of each."""
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=200)
    writer.start()
    channels = [writer.register_channel(topic, "b", 0) for topic in topics]
    for i in range(80):
        writer.add_message(channels[i % len(channels)], i, bytes(90), i)
    writer.finish()
    raw = stream.getvalue()
    (begin,) = struct.unpack_from("<Q", raw, len(raw) - 8 - 20)
    at = begin
    while raw[at] != Opcode.CHUNK_INDEX:
        at += RECORD_HEADER.size + RECORD_HEADER.unpack_from(raw, at)[1]
    length = RECORD_HEADER.unpack_from(raw, at)[1]
    width = RECORD_HEADER.size + length
    count = 0
    while raw[at + count * width] == Opcode.CHUNK_INDEX:
        count += 1
    return raw[at : at + count * width], length


def test_chunk_indexes_that_are_read_together_are_those_read_one_by_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Also where a byte of one is another."""
    random = np.random.default_rng(5)
    refused = 0
    for topics in ("x", "xy"):
        whole, length = chunk_indexes(topics)
        width = RECORD_HEADER.size + length
        count = len(whole) // width
        assert count >= 38
        for case in range(150):
            raw = bytearray(whole)
            if case:
                at = RECORD_HEADER.size + case % length  # every byte, in any of them
                raw[int(random.integers(count)) * width + at] ^= int(random.integers(1, 256))
            found = []
            for few in (2, 10**9):
                monkeypatch.setattr(summary, "_FEW", few)
                try:
                    ways = summary._segments(Held(bytes(raw)), RECORD_HEADER.size, length, count)
                    found.append(list(ways))
                except MalformedRecord as error:
                    found.append([str(error)])
            assert found[0] == found[1]
            refused += not all(found[0]) or len(found[0]) < count
    assert 20 < refused < 280


def test_runs_of_chunk_indexes_of_several_lengths_are_all_found() -> None:
    one, other = chunk_indexes("x"), chunk_indexes("xy")
    data = one[0] + other[0] + one[0]
    at, found = 0, []
    while at < len(data):
        width = RECORD_HEADER.size + RECORD_HEADER.unpack_from(data, at)[1]
        rows = summary._alike(Held(data), at, len(data), width)
        found.append(rows.tobytes())
        at += rows.size
    assert found == [one[0], other[0], one[0]]


@pytest.mark.parametrize("size", [1, 65_535, 65_536, 65_537, 200_000])
@pytest.mark.parametrize("stated", [True, False])
def test_lz4_is_decompressed_in_pieces_and_refused_where_it_holds_more_or_less(
    size: int, stated: bool
) -> None:
    data = np.random.default_rng(size).integers(0, 9, size, np.uint8).tobytes()
    stored = memoryview(lz4.frame.compress(data, store_size=stated))
    out = np.empty(size, np.uint8)
    Decompressor().decompress(stored, "lz4", out)
    assert out.tobytes() == data
    for wrong in (size - 1, size + 1):
        with pytest.raises(MalformedRecord, match=f"it states {wrong} bytes decompressed"):
            Decompressor().decompress(stored, "lz4", np.empty(wrong, np.uint8))
    with pytest.raises(MalformedRecord, match="cut short"):
        Decompressor().decompress(stored[:-1], "lz4", out)


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_chunk_is_read_with_its_message_indexes_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compression: CompressionType
) -> None:
    path = tmp_path / "log.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1000, compression=compression)
        writer.start()
        channels = [writer.register_channel(topic, "b", 0) for topic in "xyz"]
        for i in range(60):
            writer.add_message(channels[i % 3], i, bytes([i]) * 400, i)
        writer.finish()
    with LogReader(path) as reader:
        chunks = len(reader.segments)
        reads: list[int] = []
        for name in ("read_at", "read_into"):
            read = getattr(FileStore, name)
            counted = lambda *args, read=read: reads.append(1) or read(*args)  # noqa: E731
            monkeypatch.setattr(FileStore, name, counted)
        assert [message.data[0] for message in reader.messages()] == list(range(60))
        assert len(reads) == chunks == 20
