"""Inner products of vectors with frames, tile by tile: what both kinds of SFA spend most on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arithmetic.choice import Either
from cdmisfa.core.arithmetic.compiled import compiled, reordered
from cdmisfa.features.lanes import LANES, load, multiply_add, total, zeros

Float = NDArray[np.float64]

ROWS = 4
"""Frames measured at once: three vectors and so many sums fit into registers."""


@compiled
def _measure_in_order(
    v: Float, column: int, width: int, rows: int, u: Float, first: int, e: Float
) -> None:
    """See `_measure_tile`; eight sums side by side, then theirs, then of what is left."""
    whole = width - width % LANES
    for j in range(rows):
        a, b, c, d = zeros(), zeros(), zeros(), zeros()
        for i in range(0, whole, LANES):
            x = load(v, j, column + i)
            a = multiply_add(a, x, load(u, first, i))
            b = multiply_add(b, x, load(u, first + 1, i))
            c = multiply_add(c, x, load(u, first + 2, i))
            d = multiply_add(d, x, load(u, first + 3, i))
        for k, y in enumerate((total(a), total(b), total(c), total(d))):
            for i in range(whole, width):
                y += v[j, column + i] * u[first + k, i]
            e[j, first + k] += y


@reordered
def _measure_tile(
    v: Float, column: int, width: int, rows: int, u: Float, first: int, e: Float
) -> None:
    """Add a tile's share of the inner products of vectors with ROWS frames.

    Args:
        v: (K, I) vectors.
        column: first of the tile's columns in v.
        width: columns.
        rows: vectors that count.
        u: (n, TILE) the frames in the tile.
        first: index of the first of the frames.
        e: (K, n), columns [first, first + ROWS) in place.
    """
    u0, u1 = u[first, :width], u[first + 1, :width]
    u2, u3 = u[first + 2, :width], u[first + 3, :width]
    for j in range(0, rows - 2, 3):
        vx, vy = v[j, column : column + width], v[j + 1, column : column + width]
        vz = v[j + 2, column : column + width]
        x0 = x1 = x2 = x3 = y0 = y1 = y2 = y3 = z0 = z1 = z2 = z3 = 0.0
        for i in range(width):
            x, y, z = vx[i], vy[i], vz[i]
            x0 += x * u0[i]
            y0 += y * u0[i]
            z0 += z * u0[i]
            x1 += x * u1[i]
            y1 += y * u1[i]
            z1 += z * u1[i]
            x2 += x * u2[i]
            y2 += y * u2[i]
            z2 += z * u2[i]
            x3 += x * u3[i]
            y3 += y * u3[i]
            z3 += z * u3[i]
        for k, (a, b, c) in enumerate(((x0, y0, z0), (x1, y1, z1), (x2, y2, z2), (x3, y3, z3))):
            e[j, first + k] += a
            e[j + 1, first + k] += b
            e[j + 2, first + k] += c
    for j in range(rows - rows % 3, rows):
        vx = v[j, column : column + width]
        x0 = x1 = x2 = x3 = 0.0
        for i in range(width):
            x = vx[i]
            x0 += x * u0[i]
            x1 += x * u1[i]
            x2 += x * u2[i]
            x3 += x * u3[i]
        for k, a in enumerate((x0, x1, x2, x3)):
            e[j, first + k] += a


measure_tile = Either(_measure_tile, lambda: _measure_in_order)
"""See `_measure_tile`."""
