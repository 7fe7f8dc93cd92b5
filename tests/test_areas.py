"""Averages of the areas of images, against Pillow's."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mcap.writer import Writer
from PIL import Image

from recorder.images import areas
from recorder.images.areas import averaged
from recorder.images.framing import Fit, Framing
from recorder.images.pixels import Bytes
from replay.camera_logs.source import MANY, ForeignSource


@pytest.fixture
def untried() -> Iterator[None]:
    """No sizes are known from before, and none of the test afterwards."""
    areas._as_pillow.cache_clear()
    yield
    areas._as_pillow.cache_clear()


def by_pillow(image: Bytes, height: int, width: int) -> Bytes:
    return np.asarray(Image.fromarray(image).resize((width, height), Image.Resampling.BOX))


def noise(rows: int, columns: int, seed: int = 0, least: int = 0) -> Bytes:
    return np.random.default_rng(seed).integers(least, 256, (rows, columns), np.uint8)


sizes = st.integers(2, 120).flatmap(lambda n: st.tuples(st.just(n), st.integers(1, n)))
widths = st.integers(24, 700).flatmap(lambda n: st.tuples(st.just(n), st.integers(-(-n // 256), n)))


@settings(max_examples=60, deadline=None)
@given(sizes, widths, st.integers(0, 9), st.sampled_from([0, 250, 255]))
@example((2, 2), (24, 24), 0, 0)
@example((8, 3), (24, 22), 0, 0)
@example((2, 1), (24, 1), 0, 255)
@example((120, 1), (256, 1), 0, 255)
@example((67, 23), (641, 27), 1, 0)
def test_they_have_the_bits_of_pillow(
    rows: tuple[int, int], columns: tuple[int, int], seed: int, least: int
) -> None:
    image = noise(rows[0], columns[0], seed, least)
    found = averaged(image, rows[1], columns[1])
    if rows[0] - rows[1] > 2 * (columns[0] - columns[1]):
        assert found is None
        return
    assert found is not None
    np.testing.assert_array_equal(found, by_pillow(image, rows[1], columns[1]))


@pytest.mark.parametrize(
    ("image", "frame"),
    [
        ((480, 640), (60, 80)),
        ((480, 640), (96, 128)),
        ((720, 1280), (55, 98)),
        ((1065, 1920), (56, 101)),
        ((1944, 2592), (57, 76)),
        ((2160, 3840), (58, 103)),
    ],
)
def test_they_have_the_bits_of_pillow_for_images_of_cameras(
    image: tuple[int, int], frame: tuple[int, int]
) -> None:
    of_camera = noise(*image, seed=image[0])
    middle = of_camera[3:-3, 5:-5]  # not in one piece
    middle.flags.writeable = False
    for shown in (of_camera, middle):
        found = averaged(shown, *frame)
        assert found is not None
        np.testing.assert_array_equal(found, by_pillow(shown, *frame))


@pytest.mark.parametrize(
    ("image", "frame"),
    [
        ((1, 40), (1, 5)),
        ((40, 23), (5, 5)),
        ((40, 40), (41, 5)),
        ((40, 40), (5, 41)),
        ((40, 40), (0, 5)),
        ((40, 600), (5, 2)),
        ((40, 40), (5, 23)),
        ((600, 40), (2, 5)),
    ],
)
def test_what_is_narrow_or_enlarged_or_has_large_areas_is_left_to_pillow(
    image: tuple[int, int], frame: tuple[int, int]
) -> None:
    assert averaged(noise(*image), *frame) is None


@pytest.mark.usefixtures("untried")
def test_a_pillow_with_other_bits_is_left_to_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    image, resize = noise(48, 64), Image.Image.resize
    monkeypatch.setattr(
        Image.Image, "resize", lambda self, size, _: resize(self, size, Image.Resampling.BILINEAR)
    )
    assert averaged(image, 6, 8) is None


@pytest.mark.parametrize("fit", ["crop", "pad", "stretch"])
@pytest.mark.parametrize("color", [False, True])
def test_of_many_images_frames_are_those_of_few(fit: Fit, color: bool) -> None:
    image = noise(90, 160, seed=5)
    shown = np.dstack([image, 255 - image, image // 3]) if color else image
    few = Framing((90, 160), (17, 40), fit, color)
    np.testing.assert_array_equal(replace(few, many=True).frame(shown), few.frame(shown))


def test_what_is_compiled_is_loaded_for_logs_of_many_images(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    monkeypatch.setattr(areas, "averaged", lambda *args: asked.append(args) or averaged(*args))
    for images, loaded in ((MANY - 1, False), (MANY, True)):
        path = tmp_path / f"{images}.mcap"
        shown = noise(24, 320)
        message = RawImage(width=320, height=24, step=320, encoding="mono8", data=shown.tobytes())
        with path.open("wb") as file:
            writer = Writer(file)
            writer.start()
            schema = writer.register_schema("foxglove.RawImage", "protobuf", b"")
            channel = writer.register_channel("/camera", "protobuf", schema)
            for i in range(images):
                image = message.SerializeToString()
                writer.add_message(channel, i * 40_000_000, image, i * 40_000_000)
            writer.finish()
        with contextlib.closing(ForeignSource(path, size=(3, 40))) as source:
            frames = source.take(0, 8).frames.reshape(8, 3, 40)
            np.testing.assert_array_equal(frames[7], by_pillow(shown, 3, 40))
        assert bool(asked) == loaded
