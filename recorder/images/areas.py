"""Averages of the areas of gray images, with every bit of Pillow's BOX filter, in less time.

Pillow averages along the rows, rounds to bytes, and then along the columns, with weights that are
whole numbers of 2^-22. All pixels of an area weigh the same, so their sum decides, and eight bytes
are summed at once. Each size is compared with Pillow before it is used, and left to Pillow where
it differs.
"""

from __future__ import annotations

import sys
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from cdmisfa.core.arithmetic.compiled import compiled
from cdmisfa.core.blocks import freeze

Bytes = NDArray[np.uint8]
Numbers = NDArray[np.uint64]

_ONE: Final = 1 << 22
"""The weight 1 as Pillow has it."""
_WIDEST: Final = 256
"""Most pixels of an area in a row or column: their sum fits 16 bits."""
_NARROWEST: Final = 24
"""Fewest pixels of a row: what is read past its end, 16 bytes at most, lies in the next."""
_TRIED: Final = 2000
"""Averages at least that are compared with Pillow's for each size, of 50 images at most."""


class Areas(NamedTuple):
    """The areas that pixels of a row or a column are averaged over.

    Attributes:
        starts: (n,) the first pixel of each.
        counts: (n,) its pixels.
        weights: (n,) of each of its pixels, in 2^-22.
        masks: (words, n) which of eight bytes after eight bytes are in it.
    """

    starts: Numbers
    counts: Numbers
    weights: Numbers
    masks: Numbers


def averaged(image: Bytes, height: int, width: int) -> Bytes | None:
    """Average the areas of an image into fewer pixels.

    Args:
        image: (rows, columns) uint8.
        height: rows of the result.
        width: columns of the result.

    Returns:
        (height, width) uint8 as Pillow gives it; None where that is left to Pillow.
    """
    if image.dtype != np.uint8 or not _as_pillow(*image.shape, height, width):
        return None
    return _averaged(np.ascontiguousarray(image), height, width)


@lru_cache(64)
def _as_pillow(rows: int, columns: int, height: int, width: int) -> bool:
    """Whether noise is averaged as Pillow does it, and its size is one for `average`."""
    if not (0 < height <= rows and 0 < width <= columns and rows > 1 and columns >= _NARROWEST):
        return False
    # Where a column loses more than twice as many pixels as a row, some Pillows begin with columns.
    if rows - height > 2 * (columns - width) or sys.byteorder != "little":
        return False
    if areas(columns, width) is None or areas(rows, height) is None:
        return False
    random = np.random.default_rng(rows)
    for _ in range(min(1 + _TRIED // (height * width), 50)):
        noise = random.integers(0, 256, (rows, columns), np.uint8)
        small = Image.fromarray(noise).resize((width, height), Image.Resampling.BOX)
        if not np.array_equal(np.asarray(small), _averaged(noise, height, width)):
            return False
    return True


def _averaged(image: Bytes, height: int, width: int) -> Bytes:
    (rows, columns) = image.shape
    across, down = areas(columns, width), areas(rows, height)
    assert across is not None
    assert down is not None
    last = np.zeros(columns + 16, np.uint8)
    last[:columns] = image[-1]
    part, out = np.empty((rows, width), np.uint8), np.empty((height, width), np.uint8)
    average(
        _words(image),
        _words(last),
        columns,
        across.starts,
        across.weights,
        across.masks,
        down.starts,
        down.counts,
        down.weights,
        np.empty(width, np.uint64),
        part,
        out,
    )
    return out


def _words(data: Bytes) -> Numbers:
    """The eight bytes from every byte on."""
    return freeze(np.ndarray((data.size - 7,), np.uint64, data, 0, (1,)))


@lru_cache(64)
def areas(pixels: int, count: int) -> Areas | None:
    """The areas over which Pillow averages a row or a column, by its arithmetic.

    Args:
        pixels: of the row.
        count: of the result, as many or fewer.

    Returns:
        None where areas are too large, or lack pixels.
    """
    scale = pixels / count
    support, each = 0.5 * scale, 1 / scale
    starts, counts = np.zeros(count, np.uint64), np.zeros(count, np.uint64)
    for i in range(count):
        center = (i + 0.5) * scale
        low, high = max(int(center - support + 0.5), 0), int(center + support + 0.5)
        near = range(low, min(high, pixels))
        inside = [k for k in near if -0.5 < (k - center + 0.5) * each <= 0.5]
        starts[i], counts[i] = inside[0] if inside else 0, len(inside)
    least, most = int(counts.min()), int(counts.max())
    if not 0 < least <= most <= min(least + 8, _WIDEST):
        return None
    weights = (0.5 + 1 / counts * _ONE).astype(np.uint64)
    first = 8 * np.arange(-(-most // 8))[:, None]
    bits = 8 * np.clip(counts.astype(np.int64) - first, 0, 8)
    masks = np.array([[(1 << int(n)) - 1 for n in row] for row in bits], np.uint64)
    return Areas(*map(freeze, (starts, counts, weights, masks)))


@compiled
def average(
    words: Numbers,
    last: Numbers,
    columns: int,
    across: Numbers,
    across_weights: Numbers,
    masks: Numbers,
    down: Numbers,
    counts: Numbers,
    down_weights: Numbers,
    sums: Numbers,
    part: Bytes,
    out: Bytes,
) -> None:
    """Average an image over the areas of its rows, and these over the areas of its columns.

    Args:
        words: (rows * columns - 7,) eight bytes of the image from every byte on.
        last: as `words`, of its last row and 16 bytes behind it.
        columns: of the image.
        across: (width,) as `Areas.starts` of its rows.
        across_weights: (width,) as `Areas.weights`.
        masks: (words, width) as `Areas.masks`.
        down: (height,) as `Areas.starts` of its columns.
        counts: (height,) as `Areas.counts`.
        down_weights: (height,) as `Areas.weights`.
        sums: (width,) written.
        part: (rows, width) written: averages of the rows.
        out: (height, width) written.
    """
    rows, width = part.shape
    half, shift, eight = np.uint64(_ONE >> 1), np.uint64(22), np.uint64(8)
    even, ones = np.uint64(0x00FF00FF00FF00FF), np.uint64(0x0001000100010001)
    for y in range(rows):
        source, row = (words, np.uint64(y * columns)) if y < rows - 1 else (last, np.uint64(0))
        for x in range(width):
            sums[x] = 0
        for j in range(len(masks)):
            at = row + np.uint64(8 * j)
            for x in range(width):
                word = source[at + across[x]] & masks[j, x]
                sums[x] += (word & even) + ((word >> eight) & even)
        for x in range(width):
            total = (sums[x] * ones) >> np.uint64(48)
            part[y, x] = (total * across_weights[x] + half) >> shift
    for y in range(len(out)):
        for x in range(width):
            sums[x] = half
        first = down[y]
        for i in range(first, first + counts[y]):
            for x in range(width):
                sums[x] += part[i, x] * down_weights[y]
        for x in range(width):
            out[y, x] = sums[x] >> shift
