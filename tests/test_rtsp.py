"""A network camera, by RTSP, is watched, lost and found again."""

from __future__ import annotations

import numpy as np
import pytest
from rtsp_camera import RATE, rtsp_camera

from cdmisfa.core.errors import UsageError
from recorder.cameras.words import open_live
from recorder.images.options import InputOptions


def test_a_network_camera_shows_what_it_sees_at_its_own_rate() -> None:
    with rtsp_camera(100) as word, open_live([word], InputOptions()) as source:
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
    options = InputOptions(rate=RATE)
    with (
        rtsp_camera(40) as word,
        open_live([word], options, say=said.append) as source,
    ):
        source.take_all(2 * RATE)
    assert any("left" in line and "connecting to it anew" in line for line in said), said


def test_a_network_camera_that_shows_nothing_is_said() -> None:
    with rtsp_camera(1) as word, pytest.raises(UsageError, match="left ended before a picture"):
        open_live([word], InputOptions())
