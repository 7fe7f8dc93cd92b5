"""Videos are streams of frames like folders of pictures, always of the same bits."""

from __future__ import annotations

import contextlib
import struct
from pathlib import Path

import numpy as np
import pytest
from camera_files import HEIGHT, WIDTH, pictures, write_video
from folders import external

from cdmisfa.core.errors import LogDamagedError, UsageError
from recorder.images.pixels import shrink
from replay.logs.formats.video import VideoFile

SIZE = (HEIGHT, WIDTH)


def test_a_lossless_video_gives_its_very_pixels(tmp_path: Path) -> None:
    images = write_video(tmp_path / "a.mkv", pictures(40))
    source = external(tmp_path / "a.mkv", size=SIZE)
    assert (source.spec.fps, source.spec.length, source.spec.streams) == (25.0, 40, ("a",))
    np.testing.assert_array_equal(source.take(0, 40).frames, images)
    for t in (39, 3, 4, 0, 25):
        source.seek(t)
        np.testing.assert_array_equal(source.take(0, 1).frames[0], images[t])


@pytest.mark.parametrize(
    ("ending", "codec", "pixels"),
    [
        ("mp4", "libx264", "yuv420p"),
        ("mp4", "mpeg4", "yuv420p"),
        ("avi", "mjpeg", "yuvj420p"),
        ("webm", "libvpx-vp9", "yuv420p"),
        ("mkv", "ffv1", "bgr0"),
    ],
)
def test_other_codecs_come_close_in_any_order(
    tmp_path: Path, ending: str, codec: str, pixels: str
) -> None:
    path = tmp_path / f"a.{ending}"
    images = np.array(write_video(path, pictures(60), codec=codec, pixels=pixels), float)
    with contextlib.closing(VideoFile(path)) as video:
        once = [video.image(row) for row in range(60)]
    small = np.array([shrink(image, *SIZE) for image in once], float)
    assert abs(small - images).mean() < 8
    with contextlib.closing(VideoFile(path)) as video:
        for row in (59, 0, 31, 30, 7, 8, *range(60)):
            np.testing.assert_array_equal(video.image(row), once[row])


def test_limited_luma_becomes_the_full_range(tmp_path: Path) -> None:
    flat = [np.full(SIZE, value, np.uint8) for value in (0, 64, 128, 200, 255)]
    write_video(tmp_path / "a.mkv", flat, pixels="yuv420p")
    frames = external(tmp_path / "a.mkv", size=SIZE).take(0, 5).frames
    assert abs(frames[:, 0, 0].astype(int) - [0, 64, 128, 200, 255]).max() <= 1


MATRICES = {
    "as it is": ((1, 0, 0, 1), lambda image: image),
    "clockwise": ((0, 1, -1, 0), lambda image: np.rot90(image, -1)),
    "half": ((-1, 0, 0, -1), lambda image: np.rot90(image, 2)),
    "counterclockwise": ((0, -1, 1, 0), lambda image: np.rot90(image)),
    "mirrored": ((-1, 0, 0, 1), np.fliplr),
    "upside down": ((1, 0, 0, -1), np.flipud),
    "mirrored, clockwise": ((0, 1, 1, 0), np.transpose),
}
"""What a telephone writes, and what a player makes of it."""


@pytest.mark.parametrize("how", MATRICES)
def test_a_video_of_a_telephone_stands_upright(tmp_path: Path, how: str) -> None:
    matrix, turned = MATRICES[how]
    path = tmp_path / "a.mp4"
    images = write_video(path, pictures(3), codec="libx264", pixels="yuv420p")
    state_display_matrix(path, *matrix)
    upright = turned(images[0])
    with contextlib.closing(VideoFile(path)) as video:
        small = shrink(video.image(0), *upright.shape)
        assert abs(small.astype(float) - upright).mean() < 8
    with contextlib.closing(VideoFile(path, color=True)) as video:
        assert video.image(0).shape == (4 * upright.shape[0], 4 * upright.shape[1], 3)


def state_display_matrix(path: Path, a: int, b: int, c: int, d: int) -> None:
    """Let the header of a track of an MP4 file say how a player turns it."""
    data = bytearray(path.read_bytes())
    one = 1 << 16
    matrix = (a * one, b * one, 0, c * one, d * one, 0, 0, 0, 1 << 30)
    struct.pack_into(">9i", data, data.index(b"tkhd") + 44, *matrix)
    path.write_bytes(data)


def test_times_are_those_of_the_video(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mkv", pictures(50), drop=frozenset({20, 21}))
    write_video(tmp_path / "b.mkv", pictures(50), first=5)
    both = [tmp_path / "a.mkv", tmp_path / "b.mkv"]
    with pytest.raises(UsageError, match="--align time"):
        external(both, size=SIZE)
    source = external(both, size=SIZE, align="time")
    assert (source.spec.length, source.spec.start_ns) == (45, 200_000_000)
    assert source.alignment["a"] == {"messages": 48, "repeated": 2, "dropped": 5}
    a, expected = source.take(0, 45).frames, list(pictures(50))
    np.testing.assert_array_equal(a[14], expected[19])
    np.testing.assert_array_equal(a[16], expected[19])
    np.testing.assert_array_equal(a[17], expected[22])


def test_damage_within_a_video_is_found_where_ffmpeg_sees_it(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    write_video(path, pictures(60), codec="libx264", pixels="yuv420p")
    data = bytearray(path.read_bytes())
    random = np.random.default_rng(2)
    for at in random.integers(data.index(b"mdat") + 1500, data.index(b"moov") - 100, 40):
        data[at] ^= 255
    path.write_bytes(bytes(data))
    with pytest.raises(LogDamagedError, match=r"a\.mp4: (at|FFmpeg)"):
        external(path, size=SIZE).take(0, 60)
