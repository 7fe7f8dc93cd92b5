"""A network camera, by RTSP, is recorded, learned from, lost and found again."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
import pytest
from conftest import Cdmisfa
from rtsp_camera import RATE, rtsp_camera

from cdmisfa.core.errors import UsageError
from recorder.cameras.options import LiveOptions
from recorder.cameras.words import open_live
from replay.recordings.source import RecordedSource


def test_a_network_camera_is_learned_from_live_and_recorded_alike(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    options = ["--size", "32x24", "--set", "learner.tau=15", "--max-iterations", "3", "--json"]
    with rtsp_camera(200) as left, rtsp_camera(200) as right:
        words = [left, right.replace("left", "right")]
        run = cdmisfa("learn", *words, "--record", str(tmp_path / "rec"), *options)
    assert run.code == 0, run.err
    again = cdmisfa("learn", str(tmp_path / "rec"), *options).json
    assert again["signals_sha256"] == run.json["signals_sha256"]
    with contextlib.closing(RecordedSource(tmp_path / "rec")) as source:
        assert source.spec.streams == ("left", "right")


def test_a_network_camera_shows_what_it_sees_at_its_own_rate() -> None:
    with rtsp_camera(100) as word, contextlib.closing(open_live([word], LiveOptions())) as source:
        assert source.spec.streams == ("left",)
        assert source.spec.fps == RATE
        frames = source.take(0, 20).frames
    assert frames.shape == (20, 48, 64)
    bars = frames.astype(float).mean(axis=1).argmax(axis=1)
    moved = np.diff(bars) % 56
    assert moved.max() < 28  # forward: a picture that is late comes twice, and none goes back
    assert moved.sum() > 10


def test_a_network_camera_that_breaks_is_connected_to_anew() -> None:
    said: list[str] = []
    options = LiveOptions(rate=RATE)
    with (
        rtsp_camera(40) as word,
        contextlib.closing(open_live([word], options, say=said.append)) as source,
    ):
        source.take_all(2 * RATE)
    assert any("left" in line and "connecting to it anew" in line for line in said), said


def test_a_network_camera_that_shows_nothing_is_said() -> None:
    with rtsp_camera(1) as word, pytest.raises(UsageError, match="left ended before a picture"):
        open_live([word], LiveOptions())
