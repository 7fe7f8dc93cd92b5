"""A recording in parts is the recording, whatever happened while it was written."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from contracts.sources import SourceContract, same
from folders import contents
from waiting import running, wait_for

from cdmisfa.core.blocks import FrameSource
from cdmisfa.core.errors import UsageError
from recorder.recording import record_scene
from recorder.world.oscillatory import OscillatorySource
from replay.integrity.verify import check_log
from replay.open_sources import open_recording

FRAMES = 700
SPLIT = 3.0


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("parts") / "rec"
    record_scene("oscillatory", folder, frames=FRAMES, split=SPLIT)
    return folder


class TestParts(SourceContract):
    ends = True
    long = 200

    @pytest.fixture(autouse=True)
    def _folder(self, parts: Path) -> None:
        self.folder = parts

    def open(self) -> FrameSource:
        return open_recording(self.folder)


def test_parts_read_as_one(parts: Path) -> None:
    assert len(list(parts.glob("x1-*.mcap"))) == 5
    assert check_log(parts).ok
    live, recorded = OscillatorySource(), open_recording(parts)
    assert recorded.spec.length == FRAMES
    for i in range(FRAMES // 35):
        same(live.take(i % 3, 35), recorded.take(i % 3, 35))


def test_a_resumed_recording_has_the_same_parts(parts: Path, tmp_path: Path) -> None:
    folder = tmp_path / "rec"
    for frames in (90, 300, 431, FRAMES):
        record_scene("oscillatory", folder, frames=frames, split=SPLIT, resume=True)
    assert contents(folder) == contents(parts)
    torn = folder / "x2-002.mcap"
    torn.with_name(torn.name + ".partial").write_bytes(torn.read_bytes()[:9000])
    for later in sorted(folder.glob("x2-*.mcap"))[2:]:
        later.unlink()
    record_scene("oscillatory", folder, frames=FRAMES, split=SPLIT, resume=True)
    assert contents(folder) == contents(parts)


def test_kill_9_at_any_moment_leaves_parts_that_play_and_go_on(parts: Path, tmp_path: Path) -> None:
    program = (
        "import sys, time; from pathlib import Path;"
        "from recorder.recording import record_scene;"
        "record_scene('oscillatory', Path(sys.argv[1]), frames=700, split=3.0,"
        " progress=lambda _: time.sleep(0.03))"
    )
    for count in (2, 4):
        folder = tmp_path / str(count)
        with running("-c", program, folder) as process:
            wait_for(lambda f=folder, n=count: len(list(f.glob("x3-*"))) >= n, 60, process)
        with open_recording(folder) as source:
            length = source.frames
            same(source.take(1, length), OscillatorySource().take(1, length))
        record_scene("oscillatory", folder, frames=FRAMES, split=SPLIT, resume=True)
        assert contents(folder) == contents(parts)


def test_a_lost_part_is_not_written_over(parts: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(parts, tmp_path / "rec"))
    (folder / "x2-001.mcap").unlink()
    before = contents(folder)
    with pytest.raises(UsageError, match=r"x2-002\.mcap exists, but frame 150 of x2"):
        record_scene("oscillatory", folder, frames=FRAMES, split=SPLIT, resume=True)
    assert contents(folder) == before
