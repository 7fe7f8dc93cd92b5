"""Images in their colours: red, green and blue beside one another."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from camera_files import PACKED, packed, raw
from conftest import Cdmisfa
from message_files import STEP, every, learned_alike, write_mcap
from PIL import Image

from recorder.images.framing import Framing
from recorder.images.messages import image_decoder
from recorder.images.videos import frame_colors
from replay.camera_logs.source import ForeignSource
from replay.recordings.source import RecordedSource

HEIGHT, WIDTH, COUNT = 12, 16, 60


def colors(count: int = COUNT) -> np.ndarray:
    """(count, HEIGHT, WIDTH, 3): what is slow is in the blue alone."""
    shown = np.random.default_rng(5).integers(0, 255, (count, HEIGHT, WIDTH, 3))
    shown[..., 2] = (127 + 120 * np.sin(np.arange(count) / 9))[:, None, None]
    return shown.astype(np.uint8)


def beside(images: np.ndarray) -> np.ndarray:
    return np.concatenate([images[..., c] for c in range(3)], axis=-1)


def decoded(message: bytes) -> np.ndarray:
    decode = image_decoder("foxglove.RawImage", "protobuf", color=True)
    assert decode is not None
    return decode(message)


@pytest.mark.parametrize(
    ("encoding", "places"), [("rgb8", (0, 1, 2)), ("bgr8", (2, 1, 0)), ("bgra8", (2, 1, 0, 0))]
)
def test_pixels_keep_their_colours(encoding: str, places: tuple[int, ...]) -> None:
    image = colors(1)[0]
    assert (decoded(raw(image[:, :, list(places)], encoding)) == image).all()


@pytest.mark.parametrize("bits", [8, 16])
def test_two_by_two_pixels_of_a_bayer_pattern_are_one_in_colours(bits: int) -> None:
    pattern = np.array([[10, 200, 11], [101, 30, 0], [1, 2, 3]]) << (bits - 8)
    shown = decoded(raw(pattern.astype(f"<u{bits // 8}"), f"bayer_grbg{bits}"))
    assert shown.tolist() == [[[200, 20, 101]]]


def test_gray_images_are_shown_three_times_among_colours() -> None:
    framing = Framing((2, 4), (1, 2), "crop", color=True)
    gray = np.array([[0, 10, 20, 30], [0, 10, 20, 30]], np.uint8)
    assert framing.shape == (1, 6)
    assert framing.frame(gray).tolist() == [[5, 25] * 3]
    assert framing.frame(np.stack([gray, gray + 1, gray + 2], axis=2)).tolist() == [
        [5, 25, 6, 26, 7, 27]
    ]


@pytest.mark.parametrize("form", ["yuv420p", "yuv422p", "yuv444p", "yuvj420p"])
def test_colours_of_a_video_are_those_that_ffmpeg_shows(form: str) -> None:
    av = pytest.importorskip("av")
    smooth = np.indices((32, 48)).transpose(1, 2, 0) * [5, 3]
    image = np.dstack([smooth, 200 - smooth[..., :1]]).astype(np.uint8)
    frame = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format=form)
    ours, theirs = frame_colors(frame).astype(int), frame.to_ndarray(format="rgb24").astype(int)
    inner = np.s_[2:-2, 2:-2]
    assert np.abs(ours - theirs)[inner].max() <= 6
    assert np.abs(ours - theirs)[inner].mean() < 2


def test_colours_of_other_formats_are_taken(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    image = colors(1)[0]
    (tmp_path / "pngs").mkdir()
    for i in range(3):
        Image.fromarray(image).save(tmp_path / "pngs" / f"{i}.png")
    with ForeignSource(tmp_path / "pngs", rate=5, color=True) as source:
        assert source.spec.frame_shape == (HEIGHT, 3 * WIDTH)
        assert (source.take(0, 1).frames[0] == beside(image)).all()
    for form in ("rgb24", "gray"):
        frame = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format=form)
        assert frame_colors(frame).ndim == (2 if form == "gray" else 3)


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
    with RecordedSource(tmp_path / "rec") as source:
        assert (source.take(0, COUNT).frames == beside(colors())).all()


def test_a_scene_is_recorded_and_learned_in_colours(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    pytest.importorskip("pybullet")
    small = ("--color", "--set", "scene.eyes.width=8", "--set", "scene.eyes.height=6")
    rec = tmp_path / "rec"
    done = cdmisfa("record", "icub", *small, "--frames", "80", "-o", rec)
    assert done.code == 0, done.err
    runs = []
    for source, *how in ((rec,), ("icub", *small)):
        words = ("--algorithm", "progress", "--max-iterations", "2", "--json", "--no-rerun")
        runs.append(cdmisfa("learn", source, *how, *words).json)
    assert runs[0]["signals_sha256"] == runs[1]["signals_sha256"]
    with RecordedSource(rec) as source:
        assert source.spec.frame_shape == (6, 3 * 2 * 8)
        red, green, blue = np.split(source.take(0, 1).frames[0].astype(int), 3, axis=1)
    assert red.mean() > green.mean() > blue.mean()  # the table is brown
    refused = cdmisfa("record", "oscillatory", "--color", "-o", tmp_path / "none")
    assert (refused.code, "scene.color means nothing" in refused.err) == (2, True)
