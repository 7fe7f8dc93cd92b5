"""Two cameras that cannot go back: recorded, learned from live and from the recording."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Cdmisfa
from contracts.sources import ForwardContract, same
from folders import contents
from live_cameras import SHAPE, bar

from cdmisfa.core.blocks import Block, FrameSource, SeekableSource, SourceSpec
from cdmisfa.core.errors import LogExhaustedError, UsageError
from recorder.recording import RecordingStoppedError, record
from replay.open_sources import open_recording

FRAMES = 700


class Webcams:
    """Two cameras on one clock; whatever is not looked at is gone."""

    def __init__(self, streams: tuple[str, ...] = ("left", "right"), length: int | None = None):
        self.spec = SourceSpec(streams, SHAPE, "uint8", fps=30, start_ns=10**18, length=length)
        self.t = 0
        self._cameras = len(streams)

    def take_all(self, n: int) -> tuple[Block, ...]:
        if n < 1:
            raise ValueError("a block has at least one frame")
        if self.spec.length is not None and self.t + n > self.spec.length:
            raise LogExhaustedError("the cameras were unplugged")
        blocks = []
        for stream in range(self._cameras):
            frames = np.stack([bar(stream, self.t + k) for k in range(n)])
            frames.flags.writeable = False
            truth = np.empty((n, 0))
            truth.flags.writeable = False
            blocks.append(Block(stream, self.t, frames, truth))
        self.t += n
        return tuple(blocks)

    def take(self, stream: int, n: int) -> Block:
        if not 0 <= stream < self._cameras:
            raise ValueError(f"stream {stream} does not exist")
        return self.take_all(n)[stream]

    def describe(self) -> Mapping[str, Any]:
        return {"kind": "webcams", "devices": [0, 1]}

    def close(self) -> None:
        pass


class TestWebcams(ForwardContract):
    def open(self) -> FrameSource:
        return Webcams()


class TestWebcamsThatAreUnplugged(ForwardContract):
    ends = True

    def open(self) -> FrameSource:
        return Webcams(length=60)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("webcams") / "rec"
    record(Webcams(), folder, frames=FRAMES)
    return folder


def test_what_was_recorded_is_what_the_cameras_showed(cdmisfa: Cdmisfa, recording: Path) -> None:
    assert not isinstance(Webcams(), SeekableSource)
    assert sorted(contents(recording)) == ["left.mcap", "right.mcap"]
    assert cdmisfa("verify", recording).code == 0
    source = open_recording(recording)
    assert source.spec == Webcams(length=FRAMES).spec
    for one, two in zip(source.take_all(FRAMES), Webcams().take_all(FRAMES), strict=True):
        same(one, two)


@pytest.mark.parametrize("split", [None, 3.0])
def test_a_resumed_recording_is_the_same_bytes(split: float | None, tmp_path: Path) -> None:
    """A source that has not come to the missing frames yet passes over those that are there."""
    whole, folder = tmp_path / "whole", tmp_path / "rec"
    record(Webcams(), whole, frames=FRAMES, split=split)
    reported: list[float] = []
    with pytest.raises(RecordingStoppedError):
        record(
            Webcams(), folder, frames=FRAMES, split=split, progress=reported.append,
            stop=lambda: len(reported) > 24,
        )  # fmt: skip
    late = Webcams()
    late.take_all(700)
    with pytest.raises(UsageError, match=r"at frame 700, after frame \d+: open it a"):
        record(late, folder, resume=True)
    record(Webcams(), folder, resume=True)
    assert contents(folder) == contents(whole)
    untouched = Webcams()
    record(untouched, folder, split=split, resume=True)
    assert untouched.t == 0


def test_a_camera_that_is_unplugged_leaves_readable_partials(tmp_path: Path) -> None:
    class Unplugged(Webcams):
        def take_all(self, n: int) -> tuple[Block, ...]:
            if self.t >= 90:
                raise LogExhaustedError("the cameras were unplugged")
            return super().take_all(n)

    with pytest.raises(LogExhaustedError, match="unplugged"):
        record(Unplugged(), tmp_path / "rec")
    assert len(open_recording(tmp_path / "rec").take(0, 90)) == 90


def test_a_source_that_ends_is_recorded_to_its_end(tmp_path: Path) -> None:
    files = record(Webcams(length=70), tmp_path / "rec")
    assert [file.frames for file in files] == [70, 70]
    with pytest.raises(UsageError, match=r"--frames is 71: .*at most the 70"):
        record(Webcams(length=70), tmp_path / "other", frames=71)
