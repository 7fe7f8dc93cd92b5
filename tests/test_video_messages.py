"""Videos in messages, a picture each, are taken as other images are: from logs and from robots."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from camera_files import HEIGHT, WIDTH
from folders import external
from foxglove.channels import CompressedVideoChannel
from foxglove.messages import CompressedVideo
from live_cameras import Robot
from message_files import STEP, every, write_mcap
from video_packets import COUNT, ENCODERS, FOXGLOVE, GROUP, KINDS, video

from cdmisfa.core.errors import LogDamagedError, UsageError
from recorder.cameras.words import open_live
from recorder.images.messages import MessageKind
from recorder.images.options import InputOptions
from recorder.images.videos import frame_gray
from replay.logs.open_logs import open_stream
from replay.logs.stream import LogStream

DECODERS = {"h265": "hevc", "av1": "libdav1d"}


def decoded(codec: str) -> list[np.ndarray[Any, Any]]:
    """What FFmpeg shows of it, from its beginning to its end."""
    decoder: Any = av.CodecContext.create(DECODERS.get(codec, codec), "r")
    decoder.thread_count = 1
    frames = [decoder.decode(av.Packet(packet)) for packet in video(codec)]
    assert all(len(own) == 1 for own in frames)
    return [frame_gray(own[0]) for own in frames]


def write(
    path: Path, packets: Sequence[bytes], codec: str = "h264", kind: MessageKind = FOXGLOVE
) -> Path:
    messages = [KINDS[kind](packet, codec) for packet in packets]
    return write_mcap(path, kind, {"/cam": every(STEP, messages)})


def opened(path: Path) -> AbstractContextManager[LogStream]:
    return open_stream(path)


@pytest.mark.parametrize("codec", ENCODERS)
def test_pictures_of_a_video_are_the_same_in_any_order(tmp_path: Path, codec: str) -> None:
    path, expected = write(tmp_path / "a.mcap", video(codec), codec), decoded(codec)
    with opened(path) as images:
        for row in (*range(COUNT), 59, 0, 31, 32, 40, 30, 7, 11, 12, 13):
            np.testing.assert_array_equal(images.image(row), expected[row], err_msg=str(row))


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: f"{kind.schema} {kind.encoding}")
def test_messages_of_every_kind_hold_videos(tmp_path: Path, kind: MessageKind) -> None:
    path = write(tmp_path / "a.mcap", video("h264"), "h264", kind)
    with opened(path) as images:
        np.testing.assert_array_equal(images.image(30), decoded("h264")[30])


def test_a_video_is_taken_from_its_first_whole_picture(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", video("h264")[5:])
    with opened(path) as images:
        assert images.count == COUNT - GROUP
        assert "7 images before the first key frame are skipped" in images.warnings[-1]
        np.testing.assert_array_equal(images.image(0), decoded("h264")[GROUP])
    path = write(tmp_path / "b.mcap", video("h264")[1:GROUP])
    with pytest.raises(UsageError, match="/cam: the video has no key frame"):
        opened(path).__enter__()
    path = write(tmp_path / "c.mcap", video("h264"), "theora")
    with pytest.raises(UsageError, match="its codec 'theora' is not supported: use h264"):
        opened(path).__enter__()


def test_what_follows_a_broken_picture_is_not_made_up(tmp_path: Path) -> None:
    packets = list(video("h264"))
    packets[15] = packets[15][:-40] + bytes(40)
    path, expected = write(tmp_path / "a.mcap", packets), decoded("h264")
    with opened(path) as images:
        for row in (14, 24, 59):
            np.testing.assert_array_equal(images.image(row), expected[row])
    with (
        external(path, size=(HEIGHT, WIDTH)) as source,
        pytest.raises(LogDamagedError, match="its video is damaged there"),
    ):
        source.take(0, COUNT)


def test_a_running_robots_video_is_shown_from_its_first_whole_picture() -> None:
    def message(k: int) -> CompressedVideo:
        return CompressedVideo(data=video("h264")[(k + 3) % COUNT], format="h264")

    robot = Robot()
    with contextlib.closing(robot), robot.showing(CompressedVideoChannel, "/cam", message):
        word, options = f"{robot.address}/cam", InputOptions(rate=50)
        with open_live([word], options) as source:
            frames = source.take(0, 30).frames
    shown = decoded("h264")
    result = [next((k for k in range(COUNT) if (shown[k] == f).all()), None) for f in frames]
    assert None not in result
    assert len(set(result)) > 3
