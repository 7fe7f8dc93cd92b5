"""Damaged pictures: what their format tells is told, and what it cannot tell is said."""

from __future__ import annotations

import io
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from PIL import Image

from recorder.images.compressed import compressed_image
from recorder.images.pixels import MalformedImage

Damage = Callable[[bytes, np.random.Generator], bytes]

PNG: dict[str, dict[str, Any]] = {
    "PNG": {"format": "PNG"},
    "PNG of 16 bit": {"format": "PNG", "bits": 16},
    "PNG of a palette": {"format": "PNG", "mode": "P"},
}
JPEG: dict[str, dict[str, Any]] = {
    "JPEG": {"format": "JPEG", "quality": 85},
    "JPEG in gray": {"format": "JPEG", "mode": "L", "quality": 75},
    "JPEG of few colours": {"format": "JPEG", "quality": 85, "optimize": True},
    "JPEG in CMYK": {"format": "JPEG", "mode": "CMYK"},
    "JPEG with restarts": {"format": "JPEG", "restart_marker_rows": 1},
    "progressive JPEG": {"format": "JPEG", "progressive": True},
}


def scene(random: np.random.Generator) -> np.ndarray:
    """A picture of waves and noise, (120, 160, 3) uint8."""
    height, width = 120, 160
    y, x = np.mgrid[:height, :width]
    waves = [np.sin(x / random.uniform(5, 60) + y / random.uniform(5, 60)) for _ in range(3)]
    noise = random.normal(0, random.integers(6, 12), (height, width, 3))
    return np.clip(127 + 100 * np.stack(waves, 2) + noise, 0, 255).astype(np.uint8)


def packed(image: np.ndarray, mode: str = "RGB", bits: int = 8, **how: Any) -> bytes:
    file = io.BytesIO()
    picture = Image.fromarray(image).convert(mode)
    if bits == 16:
        picture = Image.fromarray(np.asarray(picture.convert("L")) * np.uint16(200))
    picture.save(file, **how)
    return file.getvalue()


def end_of_zeros(whole: bytes, random: np.random.Generator) -> bytes:
    size = int(random.integers(3, len(whole) * 6 // 10))
    return whole[:-size] + bytes(size)


def part_of_zeros(whole: bytes, random: np.random.Generator) -> bytes:
    """As a sector of a disk that was never written, behind the head of a file."""
    start = int(random.integers(1024, len(whole) - 512))
    return whole[:start] + bytes(512) + whole[start + 512 :]


def cut(whole: bytes, random: np.random.Generator) -> bytes:
    return whole[: int(random.integers(len(whole)))]


def flipped(whole: bytes, random: np.random.Generator) -> bytes:
    damaged = bytearray(whole)
    damaged[int(random.integers(len(whole)))] ^= 1 << int(random.integers(8))
    return bytes(damaged)


def accepted(kind: dict[str, Any], damage: Damage, tries: int = 30) -> int:
    """How many damaged pictures are decoded to other pixels than the whole ones."""
    random = np.random.default_rng(zlib.crc32(repr(kind).encode()))
    wrong = 0
    for _ in range(tries):
        whole = packed(scene(random), **kind)
        damaged = damage(whole, random)
        try:
            result = compressed_image(damaged, color=True)
        except MalformedImage:
            continue
        wrong += not np.array_equal(result, compressed_image(whole, color=True))
    return wrong


@pytest.mark.parametrize("damage", [end_of_zeros, part_of_zeros, flipped, cut])
@pytest.mark.parametrize("kind", PNG)
def test_no_damaged_png_is_read(kind: str, damage: Damage) -> None:
    assert accepted(PNG[kind], damage) == 0


@pytest.mark.parametrize("damage", [end_of_zeros, cut])
@pytest.mark.parametrize("kind", JPEG)
def test_no_jpeg_without_its_end_is_read(kind: str, damage: Damage) -> None:
    assert accepted(JPEG[kind], damage) == 0


@pytest.mark.parametrize("behind", [b"", bytes(2000), b"\xff\xd8\xff\xd9"])
@pytest.mark.parametrize("filled", [b"", b"\xff" * 7, bytes(32)])
@pytest.mark.parametrize("kind", JPEG)
def test_what_cameras_leave_around_the_end_is_no_damage(
    kind: str, filled: bytes, behind: bytes
) -> None:
    whole = packed(scene(np.random.default_rng(1)), **JPEG[kind])
    around = whole[:-2] + filled + whole[-2:] + behind
    with Image.open(io.BytesIO(whole)) as image:
        pixels = np.asarray(image.convert("RGB"))
    read = np.broadcast_to(compressed_image(around, color=True).T, pixels.T.shape).T
    assert np.array_equal(read, pixels)


@pytest.mark.parametrize("side", [1, 3, 8, 17])
@pytest.mark.parametrize("kind", [*PNG, *JPEG])
def test_small_pictures_are_whole(kind: str, side: int) -> None:
    flat = packed(np.full((side, side, 3), 7, np.uint8), **{**PNG, **JPEG}[kind])
    assert compressed_image(flat).shape == (side, side)
