"""Averages of the areas of gray images, with every bit of Pillow's BOX filter, in less time.

Pillow averages along the rows, rounds to bytes, and then along the columns. Each size is compared
with Pillow before it is used, and left to Pillow where it differs.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np
from PIL import Image

from cdmisfa.core.arrays import ByteArray
from cdmisfa.kernels import Struct
from cdmisfa.kernels.frames import MOST_AVERAGED, areas, average

_TRIED: Final = 2000
"""Averages at least that are compared with Pillow's for each size, of 50 images at most."""


def averaged(image: ByteArray, height: int, width: int) -> ByteArray | None:
    """Average the areas of an image into fewer pixels.

    Args:
        image: (rows, columns) uint8.
        height: rows of the result.
        width: columns of the result.

    Returns:
        (height, width) uint8 as Pillow gives it; None where that is left to Pillow.
    """
    found = _as_pillow(*image.shape, height, width)
    return found and average(image, *found)


@lru_cache(64)
def _as_pillow(rows: int, columns: int, height: int, width: int) -> tuple[Struct, Struct] | None:
    """The areas of rows and columns, if noise is averaged over them as Pillow does it."""
    # Where a column loses more than twice as many pixels as a row, some Pillows begin with columns.
    if rows - height > 2 * (columns - width):
        return None
    across, down = _areas(columns, width), _areas(rows, height)
    if across is None or down is None:
        return None
    random = np.random.default_rng(rows)
    for _ in range(min(1 + _TRIED // (height * width), 50)):
        noise = random.integers(0, 256, (rows, columns), np.uint8)
        small = Image.fromarray(noise).resize((width, height), Image.Resampling.BOX)
        if not np.array_equal(np.asarray(small), average(noise, across, down)):
            return None
    return across, down


def _areas(pixels: int, count: int) -> Struct | None:
    """The areas over which Pillow averages a row or a column, by its arithmetic.

    Returns:
        None where some are too large, or lack pixels.
    """
    if not 0 < count <= pixels:
        return None
    scale = pixels / count
    centers, half, each = (np.arange(count) + 0.5) * scale, 0.5 * scale, 1 / scale
    low = np.maximum((centers - half + 0.5).astype(np.int64), 0)
    high = np.minimum((centers + half + 0.5).astype(np.int64), pixels)
    low += (low - centers + 0.5) * each <= -0.5
    high -= (high - 1 - centers + 0.5) * each > 0.5
    counts = high - low
    if not 0 < counts.min() <= counts.max() <= MOST_AVERAGED:
        return None
    return areas(pixels, low, counts)
