"""The parts of recursive SFA that touch whole frames: two passes over tiles of columns.

One takes the inner products of a block's frames with the basis and with each other, the other
writes the new basis. Everything between them is small (`merge`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arithmetic.compiled import compiled, reordered
from cdmisfa.features.inner_products import ROWS, measure_tile
from cdmisfa.features.lanes import LANES, add, load, store

Float = NDArray[np.float64]
Int = NDArray[np.int64]

TILE = 128
"""Columns of a tile: a block of 40 frames in it is 40 KB, about L1."""


@compiled
def measure(
    basis: Float,
    rank: int,
    frames: NDArray[Any],
    scale: float,
    last: Float,
    mean: Float,
    e: Float,
    g: Float,
) -> None:
    """Inner products of a block with the basis and with itself, both less the mean.

    Args:
        basis: (L, I).
        rank: rows of the basis in use.
        frames: (m, I) values or pixels.
        scale: 1 for values, 1/255 for pixels.
        last: (I,) the frame before the block, scaled.
        mean: (I,).
        e: (L, n) receives basis times frames, n >= m + 1; column 0 is that of `last`.
        g: (n, n) receives frames times frames, row and column 0 those of `last`.
    """
    size, n = len(mean), len(g)
    u = np.zeros((n, TILE))
    e[:] = 0.0
    g[:] = 0.0
    for start in range(0, size, TILE):
        width = min(TILE, size - start)
        _centre_tile(frames, scale, last, mean, start, width, u)
        for s in range(0, n, ROWS):
            measure_tile(basis, start, width, rank, u, s, e)
            measure_tile(u, 0, width, s + ROWS, u, s, g)
    for s in range(n):
        for t in range(s):
            g[s, t] = g[t, s]


@reordered
def _centre_tile(
    frames: NDArray[Any], scale: float, last: Float, mean: Float, start: int, width: int, u: Float
) -> None:
    m = mean[start : start + width]
    row, own = last[start : start + width], u[0, :width]
    for i in range(width):
        own[i] = row[i] - m[i]
    for t in range(frames.shape[0]):
        shown, own = frames[t, start : start + width], u[t + 1, :width]
        for i in range(width):
            own[i] = shown[i] * scale - m[i]


@compiled
def rebuild(
    basis: Float,
    old: Int,
    frames: NDArray[Any],
    chosen: Int,
    scale: float,
    mean: Float,
    weights: Float,
    step: float,
) -> None:
    """Write the new basis, and move the mean.

    Args:
        basis: (L, I), in place; as many rows as `weights` has are written.
        old: rows of the old basis that the new one is made of.
        frames: (m, I) values or pixels.
        chosen: frames that the new one is made of.
        scale: 1 for values, 1/255 for pixels.
        mean: (I,), in place.
        weights: (k, P + 1) of the P rows above, frames less the mean, and of their mean.
        step: share of the way that the mean goes to the block's.
    """
    size, (rank, parts) = len(mean), weights.shape
    rows, out = np.zeros((parts + 1, TILE)), np.zeros((rank, TILE))  # the last row stays 0
    for start in range(0, size, TILE):
        width = min(TILE, size - start)
        _gather_tile(basis, old, frames, chosen, scale, mean, start, width, rows)
        _combine_tile(weights, rows, width, out)
        for j in range(rank):
            own, new = basis[j, start : start + width], out[j]
            for i in range(width):
                own[i] = new[i]
        for i in range(width):
            mean[start + i] += step * rows[parts - 1, i]


@reordered
def _gather_tile(
    basis: Float,
    old: Int,
    frames: NDArray[Any],
    chosen: Int,
    scale: float,
    mean: Float,
    start: int,
    width: int,
    rows: Float,
) -> None:
    m, count = mean[start : start + width], len(old)
    for k in range(count):
        row, own = basis[old[k], start : start + width], rows[k]
        for i in range(width):
            own[i] = row[i]
    for k in range(len(chosen)):
        shown, own = frames[chosen[k], start : start + width], rows[count + k]
        for i in range(width):
            own[i] = shown[i] * scale - m[i]
    own = rows[count + len(chosen)]
    own[:] = 0.0
    for t in range(frames.shape[0]):
        shown = frames[t, start : start + width]
        for i in range(width):
            own[i] += shown[i] * scale - m[i]
    for i in range(width):
        own[i] /= frames.shape[0]


@reordered
def _combine_tile(weights: Float, rows: Float, width: int, out: Float) -> None:
    """Set out to weights times rows, up to the next multiple of LANES columns."""
    count, parts = weights.shape
    whole = count - count % 4
    for i in range(0, width, LANES):
        zero = load(rows, parts, 0)
        for j in range(0, whole, 4):
            a, b, c, d = zero, zero, zero, zero
            for k in range(parts):
                x = load(rows, k, i)
                a = add(a, weights, j, k, x)
                b = add(b, weights, j + 1, k, x)
                c = add(c, weights, j + 2, k, x)
                d = add(d, weights, j + 3, k, x)
            store(out, j, i, a)
            store(out, j + 1, i, b)
            store(out, j + 2, i, c)
            store(out, j + 3, i, d)
        for j in range(whole, count):
            a = zero
            for k in range(parts):
                a = add(a, weights, j, k, load(rows, k, i))
            store(out, j, i, a)
