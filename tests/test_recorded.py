"""A recording plays back to the bit what was recorded, and says where it cannot."""

from __future__ import annotations

import shutil
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from contracts.sources import SourceContract, same
from folders import flip

from cdmisfa.core.blocks import Block, FrameSource, SourceSpec
from cdmisfa.core.errors import LogDamagedError, LogExhaustedError, UsageError
from recorder.config import RecordConfig
from recorder.log.manifest import RecordingSpec
from recorder.log.viewlog import ViewLog
from recorder.mcap.reader import LogReader
from recorder.recording import record_scene
from recorder.world.oscillatory import OscillatorySource
from replay.integrity.recover import recover_log
from replay.integrity.verify import check_log
from replay.open_sources import open_recording

FRAMES = 330
IMAGES = SourceSpec(("left", "right"), (12, 16), "uint8", ("x", "y"), 50.0, 10**18)


def picture_blocks(spec: SourceSpec, frames: int) -> list[Block]:
    random = np.random.default_rng(7)
    truth = random.normal(size=(frames, len(spec.truth)))
    truth[: frames // 2, 0] = 0.0
    return [
        Block(s, 0, random.integers(0, 256, (frames, *spec.frame_shape), np.uint8), truth)
        for s in range(len(spec.streams))
    ]


def write_pictures(folder: Path, **settings: object) -> list[Block]:
    blocks = picture_blocks(IMAGES, FRAMES)
    for block in blocks:
        name = IMAGES.streams[block.stream]
        identity = RecordingSpec("icub", 3, IMAGES, {})
        log = ViewLog(folder, name, identity, RecordConfig(**settings))  # type: ignore[arg-type]
        log.write(block)
        log.finish()
    return blocks


@pytest.fixture(scope="module")
def vectors(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("vectors")
    record_scene("oscillatory", folder, frames=FRAMES)
    return folder


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pictures")
    write_pictures(folder)
    return folder


@pytest.fixture
def copy(vectors: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(vectors, tmp_path / "copy"))


class TestRecorded(SourceContract):
    ends, loop = True, False
    long = 200

    @pytest.fixture(autouse=True, params=["vectors", "pictures"])
    def _folder(self, request: pytest.FixtureRequest) -> None:
        self.folder = request.getfixturevalue(request.param)

    def open(self) -> FrameSource:
        return open_recording(self.folder, loop=self.loop)


class TestLooped(TestRecorded):
    ends, loop = False, True


def test_recorded_equals_live_to_the_bit(vectors: Path) -> None:
    live, recorded = OscillatorySource(), open_recording(vectors)
    for i in range(FRAMES // 30):
        same(live.take(i % 3, 30), recorded.take(i % 3, 30))
    assert recorded.spec.streams == live.spec.streams
    assert not recorded.warnings


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_pixels_and_truth_come_back(tmp_path: Path, compression: str) -> None:
    blocks = write_pictures(tmp_path, compression=compression)
    source = open_recording(tmp_path)
    for block in blocks:
        source.seek(0)
        same(source.take(block.stream, FRAMES), block)


def test_a_loop_begins_again(pictures: Path) -> None:
    looped, once = open_recording(pictures, loop=True), open_recording(pictures)
    looped.seek(FRAMES * 5 - 10)
    block = looped.take(1, 25)
    assert block.t == FRAMES * 5 - 10
    once.seek(FRAMES - 10)
    np.testing.assert_array_equal(block.frames[:10], once.take(1, 10).frames)
    once.seek(0)
    np.testing.assert_array_equal(block.frames[10:], once.take(1, 15).frames)
    assert looped.spec.length is None


def test_the_end_names_the_remedy(vectors: Path) -> None:
    source = open_recording(vectors)
    with pytest.raises(LogExhaustedError, match="--loop"):
        source.take(0, FRAMES + 1)


def test_the_shortest_view_is_the_length(copy: Path) -> None:
    raw = (copy / "x2.mcap").read_bytes()
    (copy / "x2.mcap").unlink()
    (copy / "x2.mcap.partial").write_bytes(raw[: len(raw) // 2])
    source = open_recording(copy)
    assert source.spec.length is not None
    assert 0 < source.spec.length < FRAMES
    assert any("x2.mcap.partial" in w for w in source.warnings)
    same(source.take(1, 50), OscillatorySource().take(1, 50))
    with pytest.raises(LogExhaustedError):
        source.seek(source.spec.length + 1)


def test_files_may_be_named_in_any_order(vectors: Path) -> None:
    source = open_recording([vectors / "x3.mcap", vectors / "x1.mcap"])
    assert source.spec.streams == ("x1", "x3")
    np.testing.assert_array_equal(source.take(1, 9).frames, OscillatorySource().take(2, 9).frames)


def test_what_does_not_belong_together_is_refused(vectors: Path, pictures: Path) -> None:
    with pytest.raises(UsageError, match="are different recordings: give one"):
        open_recording([vectors, pictures])
    with pytest.raises(LogDamagedError, match="a part is missing or duplicated"):
        open_recording([vectors / "x1.mcap", vectors / "x1.mcap"])
    with pytest.raises(UsageError, match="no such"):
        open_recording(vectors / "nothing")


def damage(path: Path) -> tuple[int, int]:
    """Flip a byte in the third chunk; give its first and last log time."""
    with LogReader(path) as reader:
        chunk = reader.segments[2]
    flip(path, chunk.data_offset + chunk.stored // 2)
    return chunk.start, chunk.end


def test_damage_stops_and_is_named(copy: Path) -> None:
    start, end = damage(copy / "x1.mcap")
    with pytest.raises(LogDamagedError, match=rf"x1\.mcap.*{start} to {end}"):
        open_recording(copy).describe()
    source = open_recording(copy)
    assert len(source.take(0, 100)) == 100
    with pytest.raises(LogDamagedError, match=rf"x1\.mcap.*{start} to {end}"):
        source.take(0, 1)
    assert any("data section" in problem.where for problem in check_log(copy).problems)


def test_damage_in_one_view_is_skipped_in_every_view(copy: Path) -> None:
    damage(copy / "x1.mcap")
    source = open_recording(copy, skip_damaged=True)
    assert source.frames == FRAMES - 50
    assert any("50 frames" in w for w in source.warnings)
    live = OscillatorySource()
    expected = np.concatenate([live.take(2, FRAMES).frames[:100], live_frames(2, 150, FRAMES)])
    np.testing.assert_array_equal(source.take(2, FRAMES - 50).frames, expected)


def live_frames(stream: int, start: int, stop: int) -> np.ndarray:
    live = OscillatorySource()
    live.seek(start)
    return live.take(stream, stop - start).frames


def test_recover_saves_what_is_readable(copy: Path, tmp_path: Path) -> None:
    damage(copy / "x1.mcap")
    report = recover_log(copy / "x1.mcap", tmp_path / "saved.mcap")
    assert not report.complete
    assert {(c.topic, c.kept, c.lost) for c in report.channels} == {
        ("/view/x1", FRAMES - 50, 50),
        ("/truth", FRAMES - 50, 50),
    }
    with (
        LogReader(copy / "x1.mcap", skip_damaged=True) as old,
        LogReader(tmp_path / "saved.mcap") as new,
    ):
        assert new.complete
        assert [m.data for m in old.messages()] == [m.data for m in new.messages()]
        (before,), (after,) = old.metadata, new.metadata
        assert after.metadata == before.metadata | {"gaps": "True"}
    with pytest.raises(UsageError, match="--force"):
        recover_log(copy / "x1.mcap", tmp_path / "saved.mcap")


def test_memory_does_not_grow_with_the_length(pictures: Path) -> None:
    source, peaks = open_recording(pictures, loop=True), []
    for blocks in (10, 60):
        tracemalloc.start()
        for _ in range(blocks):
            source.take(0, 40)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.5 * peaks[0]
