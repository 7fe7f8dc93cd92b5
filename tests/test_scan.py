"""The kernels that read a chunk against the tables, on sound and on broken chunks."""

from __future__ import annotations

import contextlib
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import frames as reference

from cdmisfa.core.blocks import Block, SourceSpec
from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.kernels import frames as kernels
from recorder.config import RecordConfig
from recorder.log.manifest import RecordingSpec
from recorder.log.viewlog import ViewLog
from recorder.mcap.reader import LogReader
from recorder.mcap.records import INDEX_HEADER, Segment
from recorder.mcap.tables import indexed_table
from recorder.recording import record_scene
from replay.recordings.scanner import ChunkScanner
from replay.recordings.view_file import ViewFile
from tools.fuzz.oracle import tabled_rows

pytestmark = pytest.mark.usefixtures("both_modules")

FRAMES = 200
BUFFER = np.empty(1 << 20, np.uint8)
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
        paths[compression] = log.file.path
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


def test_vectors_are_those_of_the_tables(tmp_path: Path) -> None:
    record_scene("oscillatory", tmp_path, frames=FRAMES)
    for path in sorted(tmp_path.glob("*.mcap")):
        view = ViewFile(path)
        for ours, theirs in zip(fast(view, 3, 190), plain(view, 3, 190), strict=True):
            np.testing.assert_array_equal(ours, theirs)
        view.close()


def test_the_way_by_kernels_is_the_one_taken(pictures: dict[str, Path]) -> None:
    view = ViewFile(pictures["zstd"])
    scanner = ChunkScanner(view.reader, view._layouts)
    taken = [scanner.scanned(s, BUFFER) is not None for s in view.reader.segments]
    # The first chunk also defines the channels, and is left to the tables.
    assert taken == [False, True, True, True]
    view.close()


@pytest.fixture(scope="module")
def chunk(pictures: dict[str, Path]) -> tuple[ViewFile, bytes, bytes]:
    view = ViewFile(pictures["zstd"])
    segment = view.reader.segments[1]
    records = np.empty(segment.size, np.uint8)
    index = view.reader.unpack(segment, records)
    return view, records.tobytes(), bytes(index)


def scanned(view: ViewFile, data: bytes, index: bytes) -> np.ndarray | None:
    """The places that `scan` finds, or None where it refuses; the plain code does the same."""
    segment = view.reader.segments[1]
    counts = segment.channel_counts()
    assert counts is not None
    wanted = [counts[layout.channel.id] for layout in view._layouts]
    scanner = ChunkScanner(view.reader, view._layouts)
    found = kernels.scan(data, index, segment.start, segment.end, scanner._wanted, wanted)
    plain = reference.scan(data, index, segment.start, segment.end, *laid_out(view), wanted)
    assert (found is None) == (plain is None)
    if found is None or plain is None:
        return None
    for ours, theirs in zip(found, plain, strict=True):
        np.testing.assert_array_equal(ours, np.array(theirs, ours.dtype))
    return found[0]


def laid_out(view: ViewFile) -> tuple[list[int], list[int], list[np.ndarray], list[np.ndarray]]:
    own = view._layouts
    return (
        [x.channel.id for x in own],
        [x.least for x in own],
        [x.places for x in own],
        [x.marks for x in own],
    )


def tabled(view: ViewFile, data: bytes, index: bytes) -> np.ndarray | None:
    """The places that the tables find, or None where they refuse."""
    segment = view.reader.segments[1]
    found = []
    try:
        parts = []
        at = 0
        while at < len(index):
            pairs = int.from_bytes(index[at + 11 : at + 15], "little")
            count, rest = divmod(pairs, 16)
            if rest or index[at] != 7 or at + 15 + pairs > len(index):
                return None
            pairs_at = np.frombuffer(index, "<u8", 2 * count, at + 15).reshape(-1, 2)
            parts.append((int.from_bytes(index[at + 9 : at + 11], "little"), pairs_at))
            at += 15 + pairs
        table, _ = indexed_table(np.frombuffer(data, np.uint8), parts)
        if not (segment.start <= table.log_time.min() <= table.log_time.max() <= segment.end):
            return None
        for layout in view._layouts:
            own = table.select(np.flatnonzero(table.channel == layout.channel.id))
            found.append(layout.checked_ends(view.path, segment, own))
        return np.array(found)
    except LogDamagedError:
        return None


def test_a_sound_chunk_passes(chunk: tuple[ViewFile, bytes, bytes]) -> None:
    ours, theirs = scanned(*chunk), tabled(*chunk)
    assert ours is not None
    assert theirs is not None
    np.testing.assert_array_equal(ours, theirs)


@settings(deadline=None, max_examples=300)
@given(st.data())
def test_what_passes_broken_is_what_the_tables_pass(
    chunk: tuple[ViewFile, bytes, bytes], data: st.DataObject
) -> None:
    view, raw, index = chunk
    parts = [bytearray(raw), bytearray(index)]
    for _ in range(data.draw(st.integers(1, 3))):
        which = data.draw(st.integers(0, 1))
        # Mostly where headers, tags and lengths stand.
        at = data.draw(st.integers(0, min(400, len(parts[which]) - 1)))
        parts[which][at] = data.draw(st.sampled_from([0, 1, 5, 7, 9, 16, 31, 128, 255]))
    ours = scanned(view, bytes(parts[0]), bytes(parts[1]))
    if ours is not None:
        theirs = tabled(view, bytes(parts[0]), bytes(parts[1]))
        assert theirs is not None
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("cut", [1, 5, 16, 40, 300])
def test_a_cut_chunk_or_index_is_refused(chunk: tuple[ViewFile, bytes, bytes], cut: int) -> None:
    view, raw, index = chunk
    assert scanned(view, raw[:-cut], index) is None
    assert scanned(view, raw, index[:-cut]) is None


def test_a_flipped_bit_is_found(pictures: dict[str, Path], tmp_path: Path) -> None:
    with LogReader(pictures["none"]) as reader:
        place = reader.segments[2].data_offset + 700
    broken = bytearray(pictures["none"].read_bytes())
    broken[place] ^= 1
    path = tmp_path / "left.mcap"
    path.write_bytes(broken)
    view = ViewFile(path, salvage=True)
    scanner = ChunkScanner(view.reader, view._layouts)
    assert scanner.scanned(view.reader.segments[2], BUFFER) is None
    with pytest.raises(LogDamagedError, match="is damaged"):
        scanner.chunk(view.reader.segments[2])
    assert scanner.scanned(view.reader.segments[1], BUFFER) is not None
    view.close()


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
    heads = [range(chunk.offset, chunk.data_offset)]
    heads += [range(part.offset - INDEX_HEADER, part.offset) for part in chunk.indexes]
    places = [place for head in heads for place in head]
    path = tmp_path / "left.mcap"
    for place in places:
        raw[place] ^= 2
        path.write_bytes(raw)
        raw[place] ^= 2
        with contextlib.closing(ViewFile(path)) as view:
            assert fast(view, 0, 100)[0].any()
            with pytest.raises(LogDamagedError, match=f"chunk at byte {chunk.offset} .*"):
                fast(view, 99, 2)
    assert len(places) == 49 + len(chunk.compression) + 2 * INDEX_HEADER


@pytest.mark.parametrize("which", [0, 1])
def test_a_time_that_is_not_its_frames_is_refused_where_its_chunk_is_read(
    pictures: dict[str, Path], tmp_path: Path, which: int
) -> None:
    """Even if its index and all checksums that are read agree."""
    chunk, raw = parts_of(pictures["none"], 2)
    pair = chunk.indexes[which].offset + 16 * 7
    time, place = struct.unpack_from("<QQ", raw, pair)
    later = struct.pack("<Q", time + 1)
    message = chunk.data_offset + place + 15
    assert raw[message : message + 8] == raw[pair : pair + 8]
    raw[message : message + 8] = raw[pair : pair + 8] = later
    data = raw[chunk.data_offset :][: chunk.stored]
    raw[chunk.offset + 33 : chunk.offset + 37] = struct.pack("<I", zlib.crc32(data))
    path = tmp_path / "left.mcap"
    path.write_bytes(raw)
    with contextlib.closing(ViewFile(path)) as view:
        assert fast(view, 0, 100)[0].any()
        for _ in range(2):
            with pytest.raises(LogDamagedError, match=f"after frame 106 comes log time {time + 1}"):
                fast(view, 99, 2)


@settings(deadline=None)
@given(st.data())
def test_values_are_copied_from_within_the_data_only(data: st.DataObject) -> None:
    raw = data.draw(st.binary(max_size=60))
    edge = st.sampled_from([-1, 0, 1, 2**62, -(2**63), 2**63 - 1])
    place = st.integers(0, len(raw)) | edge | edge.map(lambda n: min(n + len(raw), 2**63 - 1))
    ends = data.draw(st.lists(place, max_size=3))
    distances, width = data.draw(st.lists(place, max_size=3)), data.draw(st.integers(0, 20))
    out = np.zeros((len(ends), len(distances) * width), np.uint8)
    lows = [end - distance for end in ends for distance in distances]
    try:
        kernels.gather(raw, np.array(ends, np.int64), np.array(distances, np.int64), width, out)
    except UsageError:
        assert not out.any()
        assert any(d < width for d in distances) or any(
            not max(distances, default=0) <= end <= len(raw) for end in ends
        )
    else:
        assert all(0 <= low <= len(raw) - width for low in lows)
        assert out.tobytes() == reference.gather(raw, ends, distances, width)


def test_layouts_that_promise_too_little_are_refused(chunk: tuple[ViewFile, bytes, bytes]) -> None:
    view, data, index = chunk
    segment = view.reader.segments[1]
    counts = [50, 50]
    channels = [layout.channel.id for layout in view._layouts]
    for place in (-1, -(2**63), 2**63 - 1, len(data)):
        wanted = kernels.layouts(channels, [0, 0], [[place], [0]], [[0], [0]])
        assert kernels.scan(data, index, segment.start, segment.end, wanted, counts) is None
    for wrong in ([50, 49], [-1, 50], [50, 51]):
        wanted = kernels.layouts(channels, [0, 0], [[0], [0]], [[0], [0]])
        assert kernels.scan(data, index, segment.start, segment.end, wanted, wrong) is None
    assert kernels.scan(data, index, segment.start, segment.end, wanted, counts) is not None
