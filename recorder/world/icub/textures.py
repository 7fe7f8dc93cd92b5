"""Textures of the furnished room and its objects, computed from hashes.

Every value is a hash of its position, so that a texture has the same bytes on every machine and
needs no file. A texture is (SIDE, SIDE, 3) in [0, 1] and repeats without a seam.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import ByteArray

# Width and height of a texture (pixels).
SIDE = 512

Pixels = NDArray[np.float32]
Colour = Sequence[float]


def hashed(rows: int, columns: int, seed: int) -> Pixels:
    """Return (rows, columns) values in [0, 1) that depend on their position and the seed only.

    The multipliers are those of SplitMix64 and xxHash, which mix bits well. The highest 24 bits of
    a hash are kept, because float32 represents them exactly.
    """
    i, j = np.indices((rows, columns), dtype=np.uint64)
    mixed = i * np.uint64(0x9E3779B97F4A7C15) + j * np.uint64(0xC2B2AE3D27D4EB4F) + np.uint64(seed)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        mixed = (mixed ^ (mixed >> np.uint64(shift))) * np.uint64(factor)
    return ((mixed >> np.uint64(40)) / np.float32(1 << 24)).astype(np.float32)


def cloud(rows: int, columns: int, seed: int) -> Pixels:
    """Return (SIDE, SIDE) smooth noise in [0, 1) with a number of bumps along each side."""
    grid = hashed(rows, columns, seed)
    (i, u), (j, v) = (_steps(n) for n in (rows, columns))
    above, below = grid[i], grid[(i + 1) % rows]
    lines = above + (below - above) * u[:, None]
    start, stop = lines[:, j], lines[:, (j + 1) % columns]
    return start + (stop - start) * v


def _steps(n: int) -> tuple[NDArray[np.int64], Pixels]:
    """Return the bump before each pixel, and the share of the distance to the next bump."""
    at = np.arange(SIDE, dtype=np.float32) * np.float32(n) / np.float32(SIDE)
    low = at.astype(np.int64)
    u = at - low
    return low, u * u * (3 - 2 * u)


def wood(base: Colour, seed: int, boards: int) -> Pixels:
    """Draw parallel boards with fibres along the rows: tone, grain and joints."""
    at = np.arange(SIDE) * boards // SIDE
    fibres = 0.5 * cloud(3, 170, seed) + 0.3 * cloud(9, 256, seed + 1)
    fibres += 0.35 * cloud(2, 23, seed + 2)
    value = 0.7 + 0.36 * fibres + 0.2 * hashed(1, boards, seed + 3)[0][at]
    joint = np.arange(SIDE) * boards % SIDE < 3 * boards
    value[:, joint] *= 0.62
    return _painted(base, value)


def tiles(base: Colour, seed: int, across: int) -> Pixels:
    """Draw square tiles of different tones with joints."""
    at = np.arange(SIDE) * across // SIDE
    value = 0.8 + 0.16 * hashed(across, across, seed)[at][:, at] + 0.1 * cloud(64, 64, seed + 1)
    joint = np.arange(SIDE) * across % SIDE < 5 * across
    value[joint] = value[:, joint] = 0.6
    return _painted(base, value)


def plaster(base: Colour, seed: int, bumps: int) -> Pixels:
    """Draw a slightly uneven wall."""
    value = 0.88 + 0.06 * cloud(bumps, bumps, seed) + 0.08 * cloud(120, 120, seed + 1)
    return _painted(base, value)


def die(base: Colour, seed: int, spots: int) -> Pixels:
    """Draw a side of a cube: a darker frame, and light spots along the diagonal."""
    image = _painted(base, 0.85 + 0.25 * cloud(9, 9, seed))
    i, j = np.indices((SIDE, SIDE))
    image[np.minimum(np.minimum(i, j), SIDE - 1 - np.maximum(i, j)) < SIDE // 12] *= 0.55
    for k in range(spots):
        middle = SIDE * (2 * k + 2) // (2 * spots + 2)
        image[(i - middle) ** 2 + (j - middle) ** 2 < (SIDE // 10) ** 2] = (0.95, 0.93, 0.86)
    return image


def box_label(base: Colour, seed: int, bands: int) -> Pixels:
    """Draw bands around a can or a ball, every second one light."""
    image = _painted(base, 0.85 + 0.25 * cloud(12, 12, seed))
    light = (np.arange(SIDE) * (2 * bands + 1) // SIDE) % 2 == 1
    image[light] = _painted((0.93, 0.91, 0.84), 0.9 + 0.1 * cloud(12, 40, seed + 1))[light]
    return image


def _painted(base: Colour, value: Pixels) -> Pixels:
    return np.clip(value[..., None] * np.array(base, np.float32), 0.0, 1.0)


# Textures by name: functions of a color, a seed, and a number of boards, tiles, spots and so on.
TEXTURES: dict[str, Callable[[Colour, int, int], Pixels]] = {
    "wood": wood,
    "tiles": tiles,
    "plaster": plaster,
    "die": die,
    "label": box_label,
}


@cache
def texture(name: str, colour: tuple[float, ...], count: int) -> ByteArray:
    """Return a texture of `TEXTURES`, (SIDE, SIDE, 3) bytes; it is drawn once in a process."""
    seed = sum(round(1000 * part) for part in colour) + count
    return np.rint(TEXTURES[name](colour, seed, count) * 255).astype(np.uint8)
