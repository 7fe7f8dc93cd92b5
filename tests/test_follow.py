"""A recording is learned from while a recorder, in another process, writes it."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import time
from contextlib import AbstractContextManager
from pathlib import Path
from subprocess import Popen
from typing import Any

import numpy as np
import pytest
from conftest import Cdmisfa
from contracts.sources import SourceContract, same
from waiting import running, started, wait_for

from cdmisfa.core.blocks import Block, ClockedSource, FrameSource, SourceSpec, freeze
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.errors import LogDamagedError, LogExhaustedError, UsageError
from cdmisfa.experiments.run_folder import RunResult
from cdmisfa.experiments.session import run
from recorder.config import Split
from recorder.mcap.store import FileStore
from recorder.recording import record, record_scene
from recorder.world.oscillatory import OscillatoryConfig, OscillatorySource
from replay.recordings.followed import FollowedSource, ReplacedError

FRAMES = 600
RECORDER = """
import sys, time
from pathlib import Path
from recorder.recording import record_scene
record_scene("oscillatory", Path(sys.argv[1]), frames=int(sys.argv[2]),
       progress=lambda done: time.sleep(float(sys.argv[3])))
"""


def recorder(folder: Path, *, wait: float = 0.02) -> AbstractContextManager[Popen[str]]:
    """A recorder that takes its time."""
    return running("-c", RECORDER, folder, FRAMES, wait)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("finished") / "rec"
    record_scene("oscillatory", folder, frames=200)
    return folder


class TestFollowed(SourceContract):
    ends = False  # how long it will be is not known

    @pytest.fixture(autouse=True)
    def _folder(self, finished: Path) -> None:
        self.folder = finished

    def open(self) -> FrameSource:
        return FollowedSource(self.folder)


def test_frames_are_waited_for_until_the_recorder_is_done(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such file or folder"):
        FollowedSource(tmp_path / "rec", timeout=0.1)
    live, unfinished = OscillatorySource(), 0
    with recorder(tmp_path / "rec", wait=0.05):
        source = FollowedSource(tmp_path / "rec", timeout=30)
        assert source.spec.length is None
        for i in range(FRAMES // 40):
            unfinished += not source.finished
            same(source.take(i % 3, 40), live.take(i % 3, 40))
        assert unfinished > 0
        with pytest.raises(LogExhaustedError, match="0 frames are left at frame 600"):
            source.take(0, 40)
        assert source.t == FRAMES
    source.close()


def test_a_recorder_that_died_is_told_from_one_that_is_slow(tmp_path: Path) -> None:
    with recorder(tmp_path / "rec", wait=0.1) as process:
        source = FollowedSource(tmp_path / "rec", timeout=30)
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    source._timeout = 0.5
    with pytest.raises(LogExhaustedError, match=r"within 0\.5 s .*--follow-timeout"):
        source.take(0, FRAMES)
    assert source.t == 0
    same(source.take(1, 20), OscillatorySource().take(1, 20))


def test_a_followed_run_is_that_on_the_scene_and_on_the_finished_recording(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    """Also where it was stopped and went on."""
    quick = ("--set", "learner.tau=20", "--json", "--max-iterations")
    folder, out = tmp_path / "rec", ("-o", tmp_path / "run", "--no-rerun")
    with recorder(folder) as process:
        assert cdmisfa("learn", folder, "--follow", *out, *quick, 3).code == 0
        followed = cdmisfa("learn", folder, "--follow", *out, "--resume", *quick, 28)
        process.wait()
    assert followed.code == 0, followed.err
    assert followed.json["source"]["followed"] is True
    later = cdmisfa("learn", folder, *quick, 28)
    for alike in (later, cdmisfa("learn", "oscillatory", *quick, 28)):
        assert followed.json["signals_sha256"] == alike.json["signals_sha256"]
    source = json.loads((tmp_path / "run" / "run.json").read_text())["source"]
    for view, whole in zip(source["views"], later.json["source"]["views"], strict=True):
        raw = (folder / whole["file"]).read_bytes()
        assert view["name"] == whole["name"]
        assert view["sha256"] == hashlib.sha256(raw[: view["bytes"]]).hexdigest()
        assert view["frames"] <= whole["frames"] == FRAMES
    assert source["config_sha256"] == later.json["source"]["config_sha256"]


@pytest.mark.parametrize("split", [None, "2s"])
def test_nothing_is_read_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, split: str | None
) -> None:
    """Whatever the recorder's pace: the bytes read grow with the recording, not with the looks."""
    read: list[int] = []
    read_at = FileStore.read_at

    def counted(self: FileStore, offset: int, count: int) -> bytes:
        data = read_at(self, offset, count)
        read.append(len(data))
        return data

    monkeypatch.setattr(FileStore, "read_at", counted)
    folder = tmp_path / "rec"
    source: list[FollowedSource] = []
    live = OscillatorySource()

    def look(done: float) -> None:
        if not source and done >= 50:
            source.append(FollowedSource(folder, timeout=30))
        if source and done >= source[0].t + 60:
            same(source[0].take(1, 10), live.take(1, 10))

    parts = None if split is None else Split.parse(split)
    record_scene("oscillatory", folder, frames=3000, split=parts, progress=look)
    followed = source[0]
    while followed.t < 3000:
        same(followed.take(1, 10), live.take(1, 10))
    assert followed.finished
    sizes = sum(path.stat().st_size for path in folder.iterdir())
    # Its structure, its log times, its frames, and its checksum at the end.
    assert sum(read) < 5 * sizes
    named = followed.describe()["views"]
    assert sum(view["frames"] for view in named) == 9000
    for view in named:
        assert view["sha256"] == hashlib.sha256((folder / view["file"]).read_bytes()).hexdigest()
    followed.close()


def test_a_resumed_recorder_is_followed_on(tmp_path: Path) -> None:
    """Going on with a recording replaces its unfinished files by others."""
    live = OscillatorySource()
    half_recorded(tmp_path / "rec", 0)
    source = FollowedSource(tmp_path / "rec", timeout=30)
    same(source.take(0, 150), live.take(0, 150))
    record_scene("oscillatory", tmp_path / "rec", resume=True)
    same(source.take(2, 250), live.take(2, 250))
    assert source.finished
    source.close()


class Unseeded(ClockedSource):
    """Two streams that show random values, and of their seed say nothing."""

    def __init__(self, seed: int) -> None:
        self._spec = SourceSpec(("a", "b"), (3,), "float64")
        self._frames = np.random.default_rng(seed).normal(size=(400, 3))

    def take(self, stream: int, n: int) -> Block:
        frames = self._frames[self._t : self._t + n] + stream
        self._t += n
        return Block(stream, self._t - n, freeze(frames), freeze(np.empty((n, 0))))

    def describe(self) -> dict[str, str]:
        return {"kind": "unseeded"}


def half_recorded(folder: Path, seed: int, frames: int = 200) -> None:
    """Leave what a recorder of 400 frames leaves that is killed after some."""

    def stop(done: float) -> None:
        if done >= frames:
            raise RuntimeError("stop")

    config = OscillatoryConfig(seed=seed)
    with pytest.raises(RuntimeError, match="stop"):
        record_scene("oscillatory", folder, config, frames=400, force=True, progress=stop)


@pytest.mark.parametrize("frames", [100, 300])
def test_another_recording_in_its_place_is_refused(tmp_path: Path, frames: int) -> None:
    half_recorded(tmp_path / "rec", 1)
    source = FollowedSource(tmp_path / "rec", timeout=30)
    source.take(0, 150)
    half_recorded(tmp_path / "rec", 2, frames)
    with pytest.raises(ReplacedError, match=r"rec: another recording took the place .*--force"):
        source.take(2, 250)
    assert source.t == 150
    source.close()


def test_other_frames_under_the_same_name_are_refused(tmp_path: Path) -> None:
    """What is no scene may show others and state the same of itself."""

    def recorded(seed: int, frames: int) -> None:
        record(Unseeded(seed), tmp_path / "rec", frames=frames, force=True)
        for path in (tmp_path / "rec").glob("*.mcap"):
            path.rename(f"{path}.partial")

    recorded(1, 100)
    source = FollowedSource(tmp_path / "rec", timeout=30)
    source.take(0, 80)
    recorded(1, 120)
    source.take(1, 30)
    recorded(2, 200)
    with pytest.raises(ReplacedError, match="another recording"):
        source.take(0, 40)
    source.close()


def test_a_resumed_run_goes_on_with_the_frames_that_it_had(tmp_path: Path) -> None:
    words = {"max_iterations": 5, "rerun": False}
    config = LearnerConfig(tau=20)

    def learned(**more: Any) -> RunResult:
        with FollowedSource(tmp_path / "rec", timeout=1) as source:
            return run(source, config, tmp_path / "run", **{**words, **more})

    record(Unseeded(1), tmp_path / "rec", frames=200)
    learned()
    record(Unseeded(0), tmp_path / "rec", frames=200, force=True)
    with pytest.raises(LogDamagedError, match="what it learned from is not there"):
        learned(resume=True, max_iterations=9)
    record(Unseeded(1), tmp_path / "rec", frames=300, force=True)
    learned(resume=True, max_iterations=9)


def test_a_signal_ends_the_waiting(cdmisfa: Cdmisfa, tmp_path: Path, finished: Path) -> None:
    with recorder(tmp_path / "rec", wait=0.5):
        words = ("learn", tmp_path / "rec", "--follow", "-o", tmp_path / "run", "--no-rerun")
        with started(*words, "--set", "learner.tau=600") as learner:
            wait_for((tmp_path / "run" / "run.mcap.partial").exists, 60, learner)
            time.sleep(0.3)
            learner.send_signal(signal.SIGINT)
            assert learner.wait(30) == 130
    assert (tmp_path / "run" / "run.json").exists()
