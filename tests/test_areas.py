"""Averages of the areas of images, against Pillow's."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from PIL import Image
from reference import frames as reference

from cdmisfa.core.errors import UsageError
from cdmisfa.kernels import frames as kernels
from recorder.images import areas, pixels
from recorder.images.areas import averaged
from recorder.images.framing import Framing
from recorder.images.pixels import Bytes
from recorder.images.reading import Fit

pytestmark = pytest.mark.usefixtures("both_modules", "untried")


@pytest.fixture(scope="module")
def untried(both_modules: None) -> Iterator[None]:
    """No sizes are known from the other module."""
    areas._as_pillow.cache_clear()
    yield
    areas._as_pillow.cache_clear()


def by_pillow(image: Bytes, height: int, width: int) -> Bytes:
    return np.asarray(Image.fromarray(image).resize((width, height), Image.Resampling.BOX))


def noise(rows: int, columns: int, seed: int = 0, least: int = 0) -> Bytes:
    return np.random.default_rng(seed).integers(least, 256, (rows, columns), np.uint8)


sizes = st.integers(1, 120).flatmap(lambda n: st.tuples(st.just(n), st.integers(1, n)))
widths = st.integers(1, 700).flatmap(lambda n: st.tuples(st.just(n), st.integers(-(-n // 256), n)))


@settings(max_examples=60, deadline=None)
@given(sizes, widths, st.integers(0, 9), st.sampled_from([0, 250, 255]))
@example((1, 1), (1, 1), 0, 0)
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
        ((40, 40), (41, 5)),
        ((40, 40), (5, 41)),
        ((40, 40), (0, 5)),
        ((40, 600), (5, 2)),
        ((40, 40), (5, 23)),
        ((600, 40), (2, 5)),
    ],
)
def test_what_is_enlarged_or_has_large_areas_is_left_to_pillow(
    image: tuple[int, int], frame: tuple[int, int]
) -> None:
    assert averaged(noise(*image), *frame) is None


def test_a_pillow_with_other_bits_is_left_to_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    image, resize = noise(48, 65), Image.Image.resize  # of a size that was not tried
    monkeypatch.setattr(
        Image.Image, "resize", lambda self, size, _: resize(self, size, Image.Resampling.BILINEAR)
    )
    assert averaged(image, 6, 8) is None


@given(st.data())
def test_areas_lie_within_the_pixels(data: st.DataObject) -> None:
    pixels = data.draw(st.tuples(st.integers(1, 40), st.integers(1, 300)))
    areas = []
    for size in reversed(pixels):
        start = st.integers(0, size - 1)
        one = start.flatmap(
            lambda at, n=size: st.tuples(st.just(at), st.integers(1, min(n - at, 256)))
        )
        areas.append(data.draw(st.lists(one, min_size=1, max_size=9)))
    image = noise(*pixels, seed=pixels[1])
    across, down = (
        kernels.areas(size, *zip(*of, strict=True))
        for size, of in zip(reversed(pixels), areas, strict=True)
    )
    np.testing.assert_array_equal(
        kernels.average(image, across, down), reference.average(image, *areas)
    )
    with pytest.raises(UsageError, match="image has the shape"):
        kernels.average(image[:, 1:], across, down)


@pytest.mark.parametrize("area", [(-1, 2), (0, 0), (0, 257), (299, 2), (2**63 - 1, 2), (0, -1)])
def test_an_area_outside_of_the_pixels_is_refused(area: tuple[int, int]) -> None:
    with pytest.raises(UsageError, match="empty, too large, or outside"):
        kernels.areas(300, [0, area[0]], [1, area[1]])


@pytest.mark.parametrize("fit", ["crop", "pad", "stretch"])
@pytest.mark.parametrize("color", [False, True])
def test_frames_are_those_of_pillow(fit: Fit, color: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    image = noise(90, 160, seed=5)
    shown = np.dstack([image, 255 - image, image // 3]) if color else image
    framing = Framing((90, 160), (17, 40), fit, color)
    ours = framing.frame(shown)
    monkeypatch.setattr(pixels, "averaged", lambda *_: None)
    np.testing.assert_array_equal(ours, framing.frame(shown))
