"""Chunks: decompressed, walked over and copied from, sound and broken."""

from __future__ import annotations

import contextlib
import struct
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import frames as reference

from cdmisfa.core.blocks import Block, SourceSpec
from cdmisfa.core.errors import LogDamagedError
from cdmisfa.kernels import frames as kernels
from recorder.config import RecordConfig
from recorder.log.manifest import RecordingSpec
from recorder.log.viewlog import ViewLog
from recorder.mcap.chunks import decompressed
from recorder.mcap.reader import LogReader
from recorder.mcap.records import MalformedRecord, Segment
from replay.logs.formats.recording import ViewFile
from tools.fuzz.oracle import tabled_rows

pytestmark = pytest.mark.usefixtures("both_modules")

FRAMES = 200
PICTURES = SourceSpec(("left",), (6, 8), "uint8", ("x", "y"), 50.0, 10**18)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The same pictures with each compression."""
    paths = {}
    random = np.random.default_rng(7)
    frames = random.integers(0, 256, (FRAMES, 6, 8), np.uint8)
    block = Block(0, 0, frames, random.normal(size=(FRAMES, 2)))
    for compression in ("zstd", "lz4", "none"):
        folder = tmp_path_factory.mktemp(compression)
        settings = RecordConfig(compression=compression)
        log = ViewLog(folder, "left", RecordingSpec("icub", 3, PICTURES, {}), settings)
        log.write(block)
        log.finish()
        paths[compression] = folder / "left.mcap"
    return paths


def plain(view: ViewFile, start: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    frames = np.empty((n, *view.facts.frame_shape), view.facts.dtype)
    truth = np.empty((n, len(view.facts.truth)))
    tabled_rows(view, start, frames, truth)
    return frames, truth


def fast(view: ViewFile, start: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    frames = np.zeros((n, *view.facts.frame_shape), view.facts.dtype)
    truth = np.zeros((n, len(view.facts.truth)))
    view.take(start, frames, truth)
    return frames, truth


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_blocks_are_those_of_the_tables(pictures: dict[str, Path], compression: str) -> None:
    view = ViewFile(pictures[compression])
    for start, n in [(0, FRAMES), (0, 1), (49, 2), (150, 50), (13, 120), (0, 40), (199, 1)]:
        for ours, theirs in zip(fast(view, start, n), plain(view, start, n), strict=True):
            np.testing.assert_array_equal(ours, theirs)
    view.close()


def chunk_of(messages: list[tuple[int, int, bytes]], between: bytes = b"") -> bytes:
    head = struct.Struct("<BQHIQQ")
    return between + b"".join(
        head.pack(5, 22 + len(data), channel, i, time, time) + data + between
        for i, (channel, time, data) in enumerate(messages)
    )


RECORDS = chunk_of([(i % 3, 100 + i, bytes(i % 40)) for i in range(60)], b"\3\2" + bytes(9))


@settings(deadline=None, max_examples=300)
@given(st.data())
def test_a_broken_chunk_is_walked_over_as_far_as_it_is_sound(data: st.DataObject) -> None:
    raw = bytearray(RECORDS[: data.draw(st.integers(0, len(RECORDS)))])
    for _ in range(data.draw(st.integers(0, 3)) if raw else 0):
        # Mostly where headers and lengths stand.
        at = data.draw(st.integers(0, min(400, len(raw) - 1)))
        raw[at] = data.draw(st.sampled_from([0, 1, 5, 7, 9, 16, 31, 128, 255]))
    messages, others, *rest = kernels.walk_records(np.frombuffer(bytes(raw), np.uint8))
    true = reference.walk_records(bytes(raw))
    assert ([row[:6] for row in messages.tolist()], others.tolist(), *rest) == true


def parts_of(path: Path, number: int) -> tuple[Segment, bytearray]:
    """A chunk as its file's summary names it, and the bytes of the file."""
    with LogReader(path) as reader:
        assert reader.by_index
        return reader.segments[number], bytearray(path.read_bytes())


@pytest.mark.parametrize("compression", ["zstd", "none"])
def test_a_chunk_that_is_not_as_the_summary_says_is_refused(
    pictures: dict[str, Path], tmp_path: Path, compression: str
) -> None:
    chunk, raw = parts_of(pictures[compression], 2)
    path = tmp_path / "left.mcap"
    for place in range(chunk.offset, chunk.data_offset):
        raw[place] ^= 2
        path.write_bytes(raw)
        raw[place] ^= 2
        with contextlib.closing(ViewFile(path)) as view:
            assert fast(view, 0, 100)[0].any()
            with pytest.raises(LogDamagedError, match=f"chunk at byte {chunk.offset} .*"):
                fast(view, 99, 2)


@settings(deadline=None)
@given(st.data())
def test_values_are_copied_from_within_the_payloads_only(data: st.DataObject) -> None:
    raw = data.draw(st.binary(max_size=60))
    edge = st.sampled_from([-1, 0, 1, 2**62, -(2**63), 2**63 - 1])
    place = st.integers(0, len(raw)) | edge
    spans = data.draw(st.lists(st.tuples(place, place, st.integers(0, 1)), max_size=5))
    messages = np.zeros(len(spans), kernels.MESSAGE)
    for name, column in zip(("at", "size", "channel"), zip(*spans, strict=True), strict=False):
        messages[name] = column
    own = [(at, size) for at, size, channel in spans if channel == 1]
    start, stop = sorted(data.draw(st.tuples(*[st.integers(0, len(own))] * 2)))
    distances, width = data.draw(st.lists(place, max_size=3)), data.draw(st.integers(0, 20))
    marks = data.draw(st.dictionaries(place, st.integers(0, 1), max_size=2))
    laid_out = data.draw(place), list(marks), list(marks.values()), distances, width
    out = np.zeros((stop - start, len(distances) * width), np.uint8)
    chunk = np.frombuffer(raw, np.uint8), messages, 1, (start, stop)
    result = kernels.gather(*chunk, kernels.layout(*laid_out), out)
    true = reference.gather(raw, own[start:stop], *laid_out)
    assert result == (None if true is None else len(own))
    assert true is None or out.tobytes() == true


@pytest.mark.parametrize("size", [1, 65_535, 65_536, 200_000])
@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("name", ["lz4", "zstd"])
def test_a_chunk_that_holds_more_or_less_than_it_states_is_refused(
    size: int, stated: bool, name: str
) -> None:
    data = np.random.default_rng(size).integers(0, 9, size, np.uint8).tobytes()
    if name == "lz4":
        raw = lz4.frame.compress(data, store_size=stated)
    else:
        raw = zstandard.ZstdCompressor(write_content_size=stated).compress(data)
    stored = np.frombuffer(raw, np.uint8)
    assert decompressed(stored, name, size).tobytes() == data
    for wrong in (size - 1, size + 1):
        with pytest.raises(MalformedRecord, match=f"it states {wrong} decompressed bytes"):
            decompressed(stored, name, wrong)
    with pytest.raises(MalformedRecord, match=r"cut short|decompressed bytes and has"):
        decompressed(stored[:-1], name, size)
    assert data.startswith(decompressed(stored[: size // 2 + 20], name, size, cut=True).tobytes())
