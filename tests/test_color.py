"""Images in their colours, red, green and blue beside one another, and when `auto` takes them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_files import PACKED, RAW, packed, raw
from conftest import Cdmisfa
from message_files import STEP, every, learned_alike, write_mcap
from numpy.typing import NDArray
from PIL import Image

from recorder.images.messages import decoder_of
from recorder.images.options import InputOptions
from recorder.images.videos import frame_colors
from replay.logs.color_choice import hue_varies
from replay.open_sources import open_recording

HEIGHT, WIDTH, COUNT = 12, 16, 60


def colors(count: int = COUNT) -> np.ndarray:
    """(count, HEIGHT, WIDTH, 3): what is slow is in the blue alone."""
    shown = np.random.default_rng(5).integers(0, 255, (count, HEIGHT, WIDTH, 3))
    shown[..., 2] = (127 + 120 * np.sin(np.arange(count) / 9))[:, None, None]
    return shown.astype(np.uint8)


def beside(images: np.ndarray) -> np.ndarray:
    return np.concatenate([images[..., c] for c in range(3)], axis=-1)


PATTERN = np.array([[10, 200, 11], [101, 30, 0], [1, 2, 3]])


@pytest.mark.parametrize(
    ("pixels", "encoding", "expected"),
    [
        (colors(1)[0], "rgb8", colors(1)[0]),
        (colors(1)[0][:, :, ::-1], "bgr8", colors(1)[0]),
        (colors(1)[0][:, :, [2, 1, 0, 0]], "bgra8", colors(1)[0]),
        (PATTERN.astype("u1"), "bayer_grbg8", [[[200, 20, 101]]]),
        ((PATTERN << 8).astype("<u2"), "bayer_grbg16", [[[200, 20, 101]]]),
    ],
)
def test_pixels_keep_their_colours(pixels: np.ndarray, encoding: str, expected: Any) -> None:
    decode = decoder_of(RAW, InputOptions(color=True))
    assert decode is not None
    np.testing.assert_array_equal(decode(raw(np.ascontiguousarray(pixels), encoding)), expected)


@pytest.mark.parametrize("form", ["yuv420p", "yuv422p", "yuv444p", "yuvj420p"])
def test_colours_of_a_video_are_those_that_ffmpeg_shows(form: str) -> None:
    import av

    smooth = np.indices((32, 48)).transpose(1, 2, 0) * [5, 3]
    image = np.dstack([smooth, 200 - smooth[..., :1]]).astype(np.uint8)
    frame = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format=form)
    ours, theirs = frame_colors(frame).astype(int), frame.to_ndarray(format="rgb24").astype(int)
    inner = np.s_[2:-2, 2:-2]
    assert np.abs(ours - theirs)[inner].max() <= 6
    assert np.abs(ours - theirs)[inner].mean() < 2


def test_colours_are_learned_from_recorded_and_replayed_alike(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    messages = (packed(image) for image in colors())
    log = write_mcap(tmp_path / "a.mcap", PACKED, {"/cam": every(STEP, messages)})
    run = learned_alike(cdmisfa, tmp_path, log, "--color")
    assert run["source"]["size"] == [HEIGHT, 3 * WIDTH]
    assert run["source"]["color"] == "red, green and blue beside one another"
    assert run["source"]["recipe"].startswith("red, green and blue")
    gray = learned_alike(cdmisfa, tmp_path / "gray", log)
    assert gray["signals_sha256"] != run["signals_sha256"]
    with open_recording(tmp_path / "rec") as source:
        assert (source.take(0, COUNT).frames == beside(colors())).all()


N, H, W = 120, 24, 32
ONE = np.ones((N, H, W))
WAVE = np.sin(np.arange(N) / 10)[:, None, None] * ONE
Y, X = np.mgrid[:H, :W]
BALL = (X - 16 - 10 * WAVE[:, :1, :1]) ** 2 + (Y - 12) ** 2 < 25
LAMP = (X < 5) & (Y < 5)


def seen(
    red: NDArray[np.float64], green: NDArray[np.float64], blue: NDArray[np.float64], sd: float = 3
) -> NDArray[np.uint8]:
    """Frames in colours through a sensor of this noise."""
    noise = np.random.default_rng(3).normal(0, sd, (N, H, 3 * W))
    frames = np.concatenate([red, green, blue], axis=2) + noise
    return np.rint(frames.clip(0, 255)).astype(np.uint8)


def ball(inside: tuple[int, int, int], outside: tuple[int, int, int]) -> NDArray[np.uint8]:
    red, green, blue = (np.where(BALL, *c) for c in zip(inside, outside, strict=True))
    return seen(red, green, blue)


NOISE = np.random.default_rng(4).integers(0, 256, (N, H // 8, 3 * W // 8), dtype=np.uint8)
MIXED = 120 + 30 * WAVE * np.random.default_rng(5).normal(0, 1, (1, H, W))

COLOR = {
    "hue alone": seen(120 + 20 * WAVE, 120 * ONE, 120 - 20 * WAVE),
    "under noise": seen(120 + 20 * WAVE, 120 * ONE, 120 - 20 * WAVE, sd=20),
    "a ball as bright as what is behind": ball((170, 85, 60), (60, 130, 125)),
    "red for green in grey frames": seen(120 + 59 * WAVE, 120 - 30 * WAVE, 120 * ONE),
    "a lamp": seen(120 + 60 * WAVE * LAMP, 120 * ONE, 120 - 60 * WAVE * LAMP),
}
GREY = {
    "grey": seen(MIXED, MIXED, MIXED, sd=0),
    "coloured noise on grey": seen(MIXED, MIXED, MIXED, sd=30),
    "coloured noise alone": seen(120 * ONE, 120 * ONE, 120 * ONE, sd=60),
    "coarse noise": np.kron(NOISE, np.ones((1, 8, 8), np.uint8)),
    "tinted light": seen(120 + 40 * WAVE, 100 + 30 * WAVE, 60 + 15 * WAVE),
    "a red ball on black": ball((200, 40, 40), (30, 30, 30)),
    "nothing moves": seen(200 * ONE, 10 * ONE, 60 * ONE, sd=0),
    "few frames": seen(120 + 20 * WAVE, 120 * ONE, 120 - 20 * WAVE)[:19],
}


@pytest.mark.parametrize("case", COLOR)
def test_hue_that_brightness_does_not_tell_is_chosen(case: str) -> None:
    assert hue_varies(COLOR[case])
    assert hue_varies(COLOR[case][:, :, ::-1])  # blue, green, red, from right to left


@pytest.mark.parametrize("case", GREY)
def test_grey_noise_and_what_brightness_tells_are_not(case: str) -> None:
    assert not hue_varies(GREY[case])


def pictures(folder: Path, frames: NDArray[np.uint8]) -> Path:
    """A folder of five pictures of each frame."""
    folder.mkdir()
    for i, frame in enumerate(np.repeat(frames, 5, axis=0)):
        rgb = np.stack(np.split(frame, 3, axis=1), axis=2)
        Image.fromarray(rgb).save(folder / f"{i:04}.png", compress_level=1)
    return folder


@pytest.mark.parametrize(
    ("frames", "said", "word", "width"),
    [
        (COLOR["hue alone"], "so frames have color", "on", 3 * W),
        (GREY["coloured noise on grey"], "frames are gray", "off", W),
    ],
)
def test_the_choice_is_said_and_the_run_goes_on_with_it(
    cdmisfa: Cdmisfa, tmp_path: Path, frames: NDArray[np.uint8], said: str, word: str, width: int
) -> None:
    log, runs = pictures(tmp_path / "log", frames), [tmp_path / name for name in ("auto", "said")]
    how = ("--rate", "20", "--no-rerun", "--max-iterations")
    auto = cdmisfa("learn", log, *how, "4", "--color", "auto", "-o", runs[0])
    assert said in auto.err
    cdmisfa("learn", log, *how, "8", "--color", word, "-o", runs[1])
    assert json.loads((runs[0] / "run.json").read_text())["command"]["color"] is (word == "on")
    resumed = cdmisfa("learn", "--resume", "-o", runs[0], *how[2:], "8")
    assert "--color auto" not in resumed.err
    assert cdmisfa("check", runs[0]).code == 0
    one, other = (json.loads((run / "run.json").read_text()) for run in runs)
    assert one["source"]["size"] == [H, width]
    assert one["result"]["signals_sha256"] == other["result"]["signals_sha256"]
    rec = tmp_path / "rec"
    assert said in cdmisfa("convert", log, "--rate", "20", "--color=auto", "-o", rec).err
