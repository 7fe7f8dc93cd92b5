"""The parts of the Gram kernel that touch whole frames: passes over tiles of columns.

Four frames are applied to all CCIPCA vectors in one read and one write of them, and the
inner products with the next four frames are taken in the same pass.

The frames of a group lie tile by tile, (tiles, GROUP, TILE), so that those of a tile are
neighbours in L1; columns beyond the last are 0.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arithmetic.compiled import compiled, reordered
from cdmisfa.core.blocks import PIXEL, UINT8
from cdmisfa.features.incsfa.state import Float, State, mean_rate
from cdmisfa.features.inner_products import ROWS, measure_tile
from cdmisfa.features.lanes import LANES, add, load, store

GROUP = ROWS
"""Frames applied in one pass."""

TILE = 256
"""Columns of a tile: the group's frames in it are 8 KB, a quarter of L1."""

PANEL = 4
"""Vectors applied with the residuals in registers; more of them would fall on the same lines
of L1, because rows of images are multiples of 4 KB."""


@reordered
def centre_tile(
    frames: NDArray[Any],
    first: int,
    count: int,
    start: int,
    mean: Float,
    n: int,
    window: float,
    u: Float,
) -> None:
    """Centre `count` frames in the columns of a tile; see `strict.centre`.

    Args:
        frames: (n, I) values or pixels.
        first: index of the first of them.
        count: how many, at most GROUP.
        start: first column.
        mean: (I,) running mean, in place.
        n: number of frames seen before them.
        window: frames of the running mean.
        u: (GROUP, TILE) receives the centred frames; rows beyond `count` become 0.
    """
    width = min(TILE, mean.shape[0] - start)
    scale = PIXEL if frames.dtype == UINT8 else 1.0
    m = mean[start : start + width]
    for s in range(count):
        rate = mean_rate(n + s + 1, window)
        offset = 0.0 if n + s == 0 else 1.0
        row, us = frames[first + s, start : start + width], u[s, :width]
        for i in range(width):
            x = row[i] * scale
            m[i] += rate * (x - m[i])
            us[i] = x - offset * m[i]
    u[count:] = 0.0


@reordered
def gram_tile(u: Float, start: int, width: int, g: Float) -> None:
    """Add a tile's share of the inner products of vectors with each other.

    Args:
        u: (K, I) vectors.
        start: first column.
        width: columns.
        g: (K, K), in place.
    """
    for s in range(u.shape[0]):
        for t in range(s + 1):
            total = 0.0
            us, ut = u[s, start : start + width], u[t, start : start + width]
            for i in range(width):
                total += us[i] * ut[i]
            g[s, t] += total
            g[t, s] = g[s, t]


@reordered
def apply_tile(v: Float, start: int, width: int, r: Float, steps: Float) -> None:
    """Apply a group's steps to all vectors in a tile of columns.

    v_j <- v_j + gain_tj r_t; r_t <- r_t + take_tj v_j for each frame t.

    Args:
        v: (K, I) CCIPCA vectors, in place.
        start: first column.
        width: columns, a multiple of LANES.
        r: (GROUP, TILE) the group's frames in the tile; overwritten.
        steps: (K, 2 GROUP) gain and take of each frame.
    """
    K = v.shape[0]
    for panel in range(0, K, PANEL):
        stop = min(panel + PANEL, K)
        for i in range(0, width, LANES):
            r0, r1, r2, r3 = load(r, 0, i), load(r, 1, i), load(r, 2, i), load(r, 3, i)
            for j in range(panel, stop):
                x = add(load(v, j, start + i), steps, j, 0, r0)
                r0 = add(r0, steps, j, 1, x)
                x = add(x, steps, j, 2, r1)
                r1 = add(r1, steps, j, 3, x)
                x = add(x, steps, j, 4, r2)
                r2 = add(r2, steps, j, 5, x)
                x = add(x, steps, j, 6, r3)
                r3 = add(r3, steps, j, 7, x)
                store(v, j, start + i, x)
            store(r, 0, i, r0)
            store(r, 1, i, r1)
            store(r, 2, i, r2)
            store(r, 3, i, r3)


@reordered
def scale_tile(v: Float, start: int, width: int, shrink: Float) -> None:
    """Multiply each vector with its factor in a tile of columns.

    Args:
        v: (K, I) vectors, in place.
        start: first column.
        width: columns.
        shrink: (K,) factors.
    """
    for j in range(v.shape[0]):
        row = v[j, start : start + width]
        for i in range(width):
            row[i] *= shrink[j]


@reordered
def features_tile(v: Float, start: int, width: int, m: Float, rows: Float) -> None:
    """Set rows to m v in a tile of columns.

    Args:
        v: (K, I) vectors.
        start: first column.
        width: columns, a multiple of LANES.
        m: (J, K) coefficients.
        rows: (J, TILE), overwritten.
    """
    J, K = m.shape
    whole = J - J % 4
    rows[:] = 0.0
    for panel in range(0, K, PANEL):
        stop = min(panel + PANEL, K)
        for j in range(0, whole, 4):
            for i in range(0, width, LANES):
                a, b = load(rows, j, i), load(rows, j + 1, i)
                c, d = load(rows, j + 2, i), load(rows, j + 3, i)
                for k in range(panel, stop):
                    x = load(v, k, start + i)
                    a = add(a, m, j, k, x)
                    b = add(b, m, j + 1, k, x)
                    c = add(c, m, j + 2, k, x)
                    d = add(d, m, j + 3, k, x)
                store(rows, j, i, a)
                store(rows, j + 1, i, b)
                store(rows, j + 2, i, c)
                store(rows, j + 3, i, d)
        for j in range(whole, J):
            for i in range(0, width, LANES):
                a = load(rows, j, i)
                for k in range(panel, stop):
                    a = add(a, m, j, k, load(v, k, start + i))
                store(rows, j, i, a)


@reordered
def replace_tile(rows: Float, start: int, phi: Float) -> float:
    """Copy the features of a tile into place; return the square of their change.

    Args:
        rows: (J, TILE).
        start: first column.
        phi: (J, I), in place.
    """
    width = min(TILE, phi.shape[1] - start)
    square = 0.0
    for j in range(phi.shape[0]):
        new, old = rows[j, :width], phi[j, start : start + width]
        for i in range(width):
            change = new[i] - old[i]
            square += change * change
            old[i] = new[i]
    return square


class Work(NamedTuple):
    """A group of up to GROUP consecutive frames, and what is to be done to the vectors.

    The vectors in memory lack their factors `shrink`, which one pass in many multiplies in.

    Attributes:
        u: (tiles, GROUP, TILE) centred frames; rows of missing frames are 0.
        g: (GROUP, GROUP) their inner products.
        e: (K, GROUP) their inner products with the vectors.
        steps: (K, 2 GROUP) see `apply_tile`.
        shrink: (K,) product of what the steps keep of each vector.
        edge: (K, TILE) columns of the last tile where it is no multiple of LANES wide.
        rows: (J, TILE) scratch.
    """

    u: Float
    g: Float
    e: Float
    steps: Float
    shrink: Float
    edge: Float
    rows: Float


@compiled
def new_work(size: int, components: int, outputs: int) -> Work:
    """Scratch for I = `size` inputs, K = `components` and J = `outputs`."""
    return Work(
        np.zeros(((size + TILE - 1) // TILE, GROUP, TILE)),
        np.zeros((GROUP, GROUP)),
        np.zeros((components, GROUP)),
        np.zeros((components, 2 * GROUP)),
        np.ones(components),
        np.zeros((components, TILE)),
        np.zeros((outputs, TILE)),
    )


@compiled
def run_pass(
    state: State,
    work: Work,
    applied: int,
    settle: bool,
    m: Float,
    frames: NDArray[Any],
    first: int,
    count: int,
    window: float,
) -> float:
    """Apply a group to the vectors, and centre and measure the next one.

    Args:
        state: mean, v and phi are brought up to date.
        work: the group; receives the next one.
        applied: how many frames it has.
        settle: multiply `shrink` in.
        m: (J, K) phi = m v is computed; of length 0 where phi is to stay.
        frames: (n, I) values or pixels.
        first: index of the next group's first frame.
        count: frames of the next group.
        window: frames of the running mean.

    Returns:
        Square of the change of phi.
    """
    size = state.mean.shape[0]
    square = 0.0
    work.g[:] = 0.0
    work.e[:] = 0.0
    for q in range(work.u.shape[0]):
        start, u = q * TILE, work.u[q]
        width = min(TILE, size - start)
        v, column, padded = state.v, start, width
        if width % LANES > 0:
            v, column, padded = work.edge, 0, width + LANES - width % LANES
            v[:, :width] = state.v[:, start:]
        if applied > 0:
            apply_tile(v, column, padded, u, work.steps)
        if settle:
            scale_tile(v, column, padded, work.shrink)
            if len(m) > 0:
                features_tile(v, column, padded, m, work.rows)
                square += replace_tile(work.rows, start, state.phi)
        if width < padded:
            state.v[:, start:] = v[:, :width]
        if count > 0:
            centre_tile(frames, first, count, start, state.mean, state.counts[0], window, u)
            measure_tile(u, 0, width, GROUP, u, 0, work.g)
            measure_tile(v, column, padded, len(work.e), u, 0, work.e)
    if settle:
        work.shrink[:] = 1.0
    for j in range(work.e.shape[0]):
        for s in range(GROUP):
            work.e[j, s] *= work.shrink[j]
    return square
