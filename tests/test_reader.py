"""LogReader reads every valid MCAP file, in order, with bounded memory."""

from __future__ import annotations

import functools
import io
import operator
import struct
import tracemalloc
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import mcap_files as files
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType
from message_files import write_mcap

from recorder.images.messages import MessageKind
from recorder.mcap.reader import LogReader

OPTIONS = (
    *("use_chunking", "use_statistics", "use_summary_offsets", "repeat_channels"),
    *("repeat_schemas", "enable_crcs", "enable_data_crcs"),
)


def written(times: Iterable[int], **options: Any) -> bytes:
    return files.written(times, lambda i: bytes([i % 256]) * 40, 300, **options)


def read(path: Path, topics: list[str] | None = None) -> list[tuple[str, int, int, int, bytes]]:
    with LogReader(path) as reader:
        result = [
            (m.channel.topic, m.sequence, m.log_time, m.publish_time, m.data)
            for m in reader.messages(topics)
        ]
        assert reader.complete
        assert not reader.missing
        assert not reader.problems
        return result


@given(
    times=st.lists(st.integers(0, 2**64 - 1) | st.integers(0, 9), max_size=60),
    index=st.sets(st.sampled_from(IndexType)),
    compression=st.sampled_from(CompressionType),
    options=st.fixed_dictionaries({name: st.booleans() for name in OPTIONS}),
)
def test_every_variant_of_the_format_is_read_in_file_order(
    tmp_path_factory: pytest.TempPathFactory,
    times: list[int],
    index: set[IndexType],
    compression: CompressionType,
    options: dict[str, bool],
) -> None:
    path = tmp_path_factory.mktemp("variant") / "log.mcap"
    types = functools.reduce(operator.or_, index, IndexType.NONE)
    path.write_bytes(written(times, index_types=types, compression=compression, **options))
    assert [(m[1], m[2]) for m in read(path)] == list(enumerate(times))
    with LogReader(path) as reader:
        assert {c.topic for c in reader.channels.values()} <= {"/a", "/b"}
        assert [reader.attachment_data(a) for a in reader.attachments] == [b"attached"]
        assert [m.metadata for m in reader.metadata] == [{"key": "value"}]
        protected = (options["enable_crcs"] and options["use_chunking"]) or options[
            "enable_data_crcs"
        ]
        assert bool(reader.crc_absent()) == (not protected and len(times) > 0)


def test_records_may_be_longer_than_their_fields(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    path.write_bytes(
        files.finish(
            files.MAGIC
            + files.header(files.PADDING)
            + files.record(files.SCHEMA, files.schema() + files.PADDING)
            + files.record(files.CHANNEL, files.channel() + files.PADDING)
            + files.chunk(files.record(files.MESSAGE, files.message(1, 0, 5, 5, b"x")), 5, 5)
            + files.record(files.METADATA, files.text("m") + files.texts({}) + files.PADDING)
        )
    )
    assert [m[4] for m in read(path)] == [b"x"]


@pytest.mark.parametrize("compression", list(CompressionType))
def test_it_agrees_with_the_reader_of_mcap(tmp_path: Path, compression: CompressionType) -> None:
    raw = written([(37 * i) % 101 for i in range(500)], compression=compression)
    (tmp_path / "log.mcap").write_bytes(raw)
    theirs = make_reader(io.BytesIO(raw), validate_crcs=True)
    for topics in (None, ["/a"], ["/b", "/c"]):
        expected = [
            (c.topic, m.sequence, m.log_time, m.publish_time, m.data)
            for _, c, m in theirs.iter_messages(topics, log_time_order=False)
        ]
        assert read(tmp_path / "log.mcap", topics) == expected
    assert expected


@pytest.mark.parametrize("known", ["nothing", "a channel", "a channel without its schema"])
def test_definitions_stand_in_chunks_without_their_messages(tmp_path: Path, known: str) -> None:
    """A definition must only stand somewhere before the first message that needs it."""
    one = files.record(files.CHANNEL, files.channel(1, 0, "/a"))
    two = files.record(files.CHANNEL, files.channel(2, 7, "/b"))
    seven = files.record(files.SCHEMA, files.schema(7))
    texts = {"nothing": (b"", one + two + seven), "a channel": (one, two + seven)}
    outside, inside = texts.get(known, (one + two, seven))
    data = files.MAGIC + files.header() + outside
    pairs = struct.pack("<HIQQ", 1, 16, 5, len(inside))
    first = inside + files.record(files.MESSAGE, files.message(1, 0, 5, 5, b"x"))
    data += files.chunk(first, 5, 5) + files.record(files.MESSAGE_INDEX, pairs)
    second = files.record(files.MESSAGE, files.message(2, 0, 3, 3, b"y"))
    data += files.chunk(second, 3, 3)
    data += files.record(files.MESSAGE_INDEX, struct.pack("<HIQQ", 2, 16, 3, 0))
    path = tmp_path / "log.mcap"
    path.write_bytes(files.finish(data))
    assert [(m[0], m[4]) for m in read(path)] == [("/a", b"x"), ("/b", b"y")]
    with LogReader(path) as reader:
        assert {c.topic for c in reader.channels.values()} == {"/a", "/b"}
        assert set(reader.schemas) == {7}


def test_unknown_records_are_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    unknown = files.record(0x80, b"private") + files.record(0x7F, b"future")
    inside = files.record(files.CHANNEL, files.channel(schema_id=0)) + unknown
    inside += files.record(files.MESSAGE, files.message(1, 0, 5, 5, b"x")) + unknown
    data = files.MAGIC + files.header() + unknown + files.chunk(inside, 5, 5) + unknown
    path.write_bytes(files.finish(data))
    assert [m[4] for m in read(path)] == [b"x"]


def test_a_long_file_is_read_in_little_memory(tmp_path: Path) -> None:
    path = tmp_path / "long.mcap"
    messages = enumerate([bytes(500_000)] * 400)
    write_mcap(path, MessageKind("", "raw"), {"/a": messages}, chunk_size=1 << 20)
    with LogReader(path) as reader:
        tracemalloc.start()
        assert sum(len(m.data) for m in reader.messages()) == 200_000_000
        assert tracemalloc.get_traced_memory()[1] <= 32 * 1024 * 1024
        tracemalloc.stop()
