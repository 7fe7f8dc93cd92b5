"""Outputs of slow features on whole blocks of frames: y = phi (x - mean)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arithmetic.choice import Either
from cdmisfa.core.arithmetic.compiled import compiled, inlined, reordered
from cdmisfa.core.blocks import PIXEL, UINT8, as_frames
from cdmisfa.core.errors import UsageError
from cdmisfa.features.inner_products import ROWS, measure_tile
from cdmisfa.features.lanes import LANES, folded, load, multiply_add, plus, spread, times, zeros

Float = NDArray[np.float64]

CHUNK = 512
"""Columns scaled at a time."""

FRAMES = 64
"""Frames scaled at a time: so many chunks stay in L2 while all rows pass."""

PANEL = 4
"""Rows that pass together; their chunks stay in L1 while all frames pass."""

STEP = 4 * LANES
"""Columns added at a time where frames and rows are taken in pairs."""


def project(phi: Float, offset: Float, frames: Any) -> Float:
    """Output y = phi x - offset of every row of phi on every frame.

    Equation: 1

    Args:
        phi: (R, I) rows of one or more abstractions.
        offset: (R,) phi times the mean.
        frames: (n, I) values, or uint8 pixels, which count 1/255 each.

    Returns:
        (n, R).

    Raises:
        UsageError: these are no frames of I values, or phi and offset no weights of some rows.
    """
    phi, offset = np.asarray(phi, dtype=np.float64), np.asarray(offset, dtype=np.float64)
    if phi.ndim != 2 or offset.shape != phi.shape[:1]:
        raise UsageError(
            f"weights of shape {phi.shape} and offsets of {offset.shape} given: give (R, I), (R,)"
        )
    return outputs(phi, offset, as_frames(frames, phi.shape[1]))


@inlined
def _product(v: Float, r: int, column: int, width: int, u: Float, t: int) -> float:
    """A row's inner product with a frame in a chunk, whose width is a multiple of STEP."""
    a, b, c, d = zeros(), zeros(), zeros(), zeros()
    for i in range(0, width, STEP):
        at = column + i
        a = multiply_add(a, load(u, t, i), load(v, r, at))
        b = multiply_add(b, load(u, t, i + LANES), load(v, r, at + LANES))
        c = multiply_add(c, load(u, t, i + 2 * LANES), load(v, r, at + 2 * LANES))
        d = multiply_add(d, load(u, t, i + 3 * LANES), load(v, r, at + 3 * LANES))
    return float(folded(plus(d, plus(c, plus(b, a)))))


@inlined
def _product_alone(
    v: Float, column: int, width: int, frames: NDArray[Any], t: int, scale: float
) -> float:
    """`_product` of the first row, with a frame that is scaled as it is read."""
    a, b, c, d, s = zeros(), zeros(), zeros(), zeros(), spread(scale)
    for i in range(0, width, STEP):
        at = column + i
        a = multiply_add(a, times(s, load(frames, t, at)), load(v, 0, at))
        b = multiply_add(b, times(s, load(frames, t, at + LANES)), load(v, 0, at + LANES))
        c = multiply_add(c, times(s, load(frames, t, at + 2 * LANES)), load(v, 0, at + 2 * LANES))
        d = multiply_add(d, times(s, load(frames, t, at + 3 * LANES)), load(v, 0, at + 3 * LANES))
    return float(folded(plus(d, plus(c, plus(b, a)))))


@inlined
def _add_pair(v: Float, r: int, column: int, width: int, u: Float, t: int, e: Float) -> None:
    """Add `_product` of two rows with two frames; each number is loaded once for two of them."""
    a0, a1, a2, a3 = zeros(), zeros(), zeros(), zeros()
    b0, b1, b2, b3 = zeros(), zeros(), zeros(), zeros()
    c0, c1, c2, c3 = zeros(), zeros(), zeros(), zeros()
    d0, d1, d2, d3 = zeros(), zeros(), zeros(), zeros()
    for i in range(0, width, STEP):
        at = column + i
        x, y = load(u, t, i), load(u, t + 1, i)
        z, w = load(v, r, at), load(v, r + 1, at)
        a0, b0 = multiply_add(a0, x, z), multiply_add(b0, x, w)
        c0, d0 = multiply_add(c0, y, z), multiply_add(d0, y, w)
        x, y = load(u, t, i + LANES), load(u, t + 1, i + LANES)
        z, w = load(v, r, at + LANES), load(v, r + 1, at + LANES)
        a1, b1 = multiply_add(a1, x, z), multiply_add(b1, x, w)
        c1, d1 = multiply_add(c1, y, z), multiply_add(d1, y, w)
        x, y = load(u, t, i + 2 * LANES), load(u, t + 1, i + 2 * LANES)
        z, w = load(v, r, at + 2 * LANES), load(v, r + 1, at + 2 * LANES)
        a2, b2 = multiply_add(a2, x, z), multiply_add(b2, x, w)
        c2, d2 = multiply_add(c2, y, z), multiply_add(d2, y, w)
        x, y = load(u, t, i + 3 * LANES), load(u, t + 1, i + 3 * LANES)
        z, w = load(v, r, at + 3 * LANES), load(v, r + 1, at + 3 * LANES)
        a3, b3 = multiply_add(a3, x, z), multiply_add(b3, x, w)
        c3, d3 = multiply_add(c3, y, z), multiply_add(d3, y, w)
    e[r, t] += folded(plus(a3, plus(a2, plus(a1, a0))))
    e[r + 1, t] += folded(plus(b3, plus(b2, plus(b1, b0))))
    e[r, t + 1] += folded(plus(c3, plus(c2, plus(c1, c0))))
    e[r + 1, t + 1] += folded(plus(d3, plus(d2, plus(d1, d0))))


@reordered
def _add_products(v: Float, column: int, width: int, count: int, u: Float, e: Float) -> None:
    """Add a chunk's share of the inner products of a few rows with some frames.

    Which frames and rows are taken in pairs does not show in their sums.

    Args:
        v: (R, I) rows.
        column: first of the chunk's columns in v.
        width: columns.
        count: frames that count.
        u: (n, CHUNK) the frames in the chunk.
        e: (R, n) in place.
    """
    rows = v.shape[0]
    if width % STEP > 0:
        for r in range(rows):
            row = v[r, column : column + width]
            for t in range(count):
                total, frame = 0.0, u[t, :width]
                for i in range(width):
                    total += frame[i] * row[i]
                e[r, t] += total
        return
    for r in range(0, rows - 1, 2):
        for t in range(0, count - 1, 2):
            _add_pair(v, r, column, width, u, t, e)
    for r in range(rows):
        alone = rows % 2 == 1 and r == rows - 1
        for t in range(0 if alone else count - count % 2, count):
            e[r, t] += _product(v, r, column, width, u, t)


@compiled
def _add_in_order(v: Float, column: int, width: int, count: int, u: Float, e: Float) -> None:
    """See `_add_products`; in the order of `measure_tile`."""
    for first in range(0, count, ROWS):
        measure_tile(v, column, width, e.shape[0], u, first, e)


add_products = Either(_add_products, lambda: _add_in_order)
"""See `_add_products`."""


@reordered
def _add_alone(
    v: Float,
    column: int,
    width: int,
    frames: NDArray[Any],
    first: int,
    count: int,
    scale: float,
    e: Float,
) -> bool:
    """`_add_products` of a single row, with frames that need no copy for it.

    Args:
        v: (1, I) the row.
        column: first of the chunk's columns.
        width: columns.
        frames: (n, I) values or pixels.
        first: index of the first of the frames.
        count: frames.
        scale: factor of what they hold.
        e: (1, n) in place.

    Returns:
        Whether that was done, which not every width allows.
    """
    if width % STEP > 0:
        return False
    for t in range(count):
        e[0, t] += _product_alone(v, column, width, frames, first + t, scale)
    return True


@compiled
def _leave_alone(
    v: Float,
    column: int,
    width: int,
    frames: NDArray[Any],
    first: int,
    count: int,
    scale: float,
    e: Float,
) -> bool:
    """See `_add_alone`; there is no such way in the order of `measure_tile`."""
    return False


add_alone = Either(_add_alone, lambda: _leave_alone)
"""See `_add_alone`."""


@reordered
def outputs(phi: Float, offset: Float, frames: NDArray[Any]) -> Float:
    """`project` for frames that were checked: compiled, and without a float copy of them.

    A row's output does not depend on which rows it is stacked with, nor a frame's on its
    block. Sums are reassociated (SIMD), hence may differ in the last digits across CPUs.

    Args:
        phi: (R, I) rows of one or more abstractions.
        offset: (R,) phi times the mean.
        frames: (n, I) as `as_frames` gives them.

    Returns:
        (n, R).
    """
    n, size = frames.shape
    rows = phi.shape[0]
    scale = PIXEL if frames.dtype == UINT8 else 1.0
    together = max(ROWS, min(FRAMES, n + -n % ROWS))
    x, e = np.zeros((together, min(CHUNK, size))), np.empty((rows, together))
    y = np.empty((n, rows))
    for first in range(0, n, together):
        count = min(together, n - first)
        e[:] = 0.0
        for start in range(0, size, CHUNK):
            width = min(CHUNK, size - start)
            if rows == 1 and add_alone(phi, start, width, frames, first, count, scale, e):
                continue
            for t in range(count):
                frame, scaled = frames[first + t, start : start + width], x[t, :width]
                for i in range(width):
                    scaled[i] = frame[i] * scale
            for r in range(0, rows, PANEL):
                add_products(phi[r : r + PANEL], start, width, count, x, e[r : r + PANEL])
        for t in range(count):
            for r in range(rows):
                y[first + t, r] = e[r, t] - offset[r]
    return y


@compiled
def mean_output(phi: Float, mean: Float) -> Float:
    """What phi gives out on the mean input, (J,): the offset of a centred projection.

    Args:
        phi: (J, I) weights.
        mean: (I,) mean of the input.
    """
    J, size = phi.shape
    offset = np.empty(J)
    for j in range(0, J - 3, 4):  # each sum waits for its last addition; four fill the wait
        a = b = c = d = 0.0
        for i in range(size):
            a += phi[j, i] * mean[i]
            b += phi[j + 1, i] * mean[i]
            c += phi[j + 2, i] * mean[i]
            d += phi[j + 3, i] * mean[i]
        offset[j], offset[j + 1], offset[j + 2], offset[j + 3] = a, b, c, d
    for j in range(J - J % 4, J):
        total = 0.0
        for i in range(size):
            total += phi[j, i] * mean[i]
        offset[j] = total
    return offset
