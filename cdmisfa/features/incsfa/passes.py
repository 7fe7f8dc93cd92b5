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
from cdmisfa.features.incsfa.cells import Cells, Columns, copy_columns
from cdmisfa.features.incsfa.state import Float, State, mean_rate
from cdmisfa.features.incsfa.still import Still, centre_still, measure_still
from cdmisfa.features.inner_products import ROWS, measure_tile
from cdmisfa.features.lanes import LANES, add, load, minus, multiply_add, spread, store, zeros

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
    cells: Cells,
    start: int,
    mean: Float,
    rate: Float,
    u: Float,
) -> None:
    """Centre `count` frames in the columns of a tile; see `strict.centre`.

    Args:
        frames: (n, I) values or pixels.
        first: index of the first of them.
        count: how many, at most GROUP.
        cells: the cells of all tiles.
        start: first column.
        mean: (1, columns) running mean in all tiles, in place.
        rate: (GROUP,) rates of the mean, 0 beyond `count`.
        u: (GROUP, TILE) receives the centred frames, and 0 in rows beyond `count` and columns
            beyond the last.
    """
    scale = PIXEL if frames.dtype == UINT8 else 1.0
    width = min(TILE, mean.shape[1] - start)
    whole = width - width % LANES
    last = first + count - 1
    t1, t2, t3 = min(first + 1, last), min(first + 2, last), min(first + 3, last)
    pixel, none = spread(scale), zeros()
    r0, r1, r2, r3 = spread(rate[0]), spread(rate[1]), spread(rate[2]), spread(rate[3])
    for i in range(0, whole, LANES):
        at, m = cells[(start + i) // LANES] * LANES, load(mean, 0, start + i)
        x = multiply_add(none, pixel, load(frames, first, at))
        m = multiply_add(m, r0, minus(x, m))
        store(u, 0, i, minus(x, m))
        x = multiply_add(none, pixel, load(frames, t1, at))
        m = multiply_add(m, r1, minus(x, m))
        store(u, 1, i, minus(x, m))
        x = multiply_add(none, pixel, load(frames, t2, at))
        m = multiply_add(m, r2, minus(x, m))
        store(u, 2, i, minus(x, m))
        x = multiply_add(none, pixel, load(frames, t3, at))
        m = multiply_add(m, r3, minus(x, m))
        store(u, 3, i, minus(x, m))
        store(mean, 0, start + i, m)
    beyond = frames.shape[1] - width
    for i in range(whole, width):
        for s in range(count):
            y = frames[first + s, beyond + i] * scale
            mean[0, start + i] += rate[s] * (y - mean[0, start + i])
            u[s, i] = y - mean[0, start + i]
    for s in range(GROUP):
        for i in range(0 if s >= count else width, TILE):
            u[s, i] = 0.0


@compiled
def first_frame(frames: NDArray[Any], cells: Cells, start: int, width: int, u: Float) -> None:
    """Take back that the very first frame was centred in a tile.

    Args:
        frames: (n, I) values or pixels.
        cells: the cells of all tiles.
        start: first column.
        width: columns.
        u: (GROUP, TILE) receives the frame.
    """
    scale = PIXEL if frames.dtype == UINT8 else 1.0
    whole = width - width % LANES
    for i in range(width):
        at = frames.shape[1] - width + i
        if i < whole:
            at = cells[(start + i) // LANES] * LANES + i % LANES
        u[0, i] = frames[0, at] * scale


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
        rate: (GROUP,) rates of the mean in the next group.
    """

    u: Float
    g: Float
    e: Float
    steps: Float
    shrink: Float
    edge: Float
    rows: Float
    rate: Float


@compiled
def new_work(size: int, components: int, outputs: int) -> Work:
    """Scratch for I = `size` inputs, K = `components` and J = `outputs`."""
    return Work(
        np.empty(((size + TILE - 1) // TILE, GROUP, TILE)),
        np.zeros((GROUP, GROUP)),
        np.zeros((components, GROUP)),
        np.zeros((components, 2 * GROUP)),
        np.ones(components),
        np.zeros((components, TILE)),
        np.zeros((outputs, TILE)),
        np.empty(GROUP),
    )


@compiled
def run_pass(
    state: State,
    columns: Columns,
    still: Still,
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
        state: phi is brought up to date, where it is computed.
        columns: mean and v are brought up to date.
        still: the other columns.
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
    begin = int(np.int64(0))  # a plain 0 has what is called compiled for it alone
    size = columns.mean.shape[1]
    square = 0.0
    work.g[:] = 0.0
    work.e[:] = 0.0
    for s in range(GROUP):
        work.rate[s] = mean_rate(state.counts[0] + s + 1, window) if s < count else 0.0
    for q in range(-1, (size + TILE - 1) // TILE):
        start, width = q * TILE, min(TILE, size - q * TILE)
        v, column, padded = columns.v, start, width
        if q < 0:
            v, column, padded, u = still.table, begin, still.table.shape[1], still.r
            if padded == 0:
                continue
        else:
            u = work.u[q]
            if width % LANES > 0:
                v, column, padded = work.edge, begin, width + LANES - width % LANES
                copy_columns(columns.v, start, v, begin, width)
        if applied > 0:
            apply_tile(v, column, padded, u, work.steps)
        if settle:
            scale_tile(v, column, padded, work.shrink)
        if q < 0:
            if count > 0:
                centre_still(still, count, state.counts[0], window)
                measure_still(still, work.g, work.e)
            continue
        if len(m) > 0:
            features_tile(v, column, padded, m, work.rows)
            square += replace_tile(work.rows, start, state.phi)
        if width < padded:
            copy_columns(v, begin, columns.v, start, width)
        if count > 0:
            centre_tile(frames, first, count, columns.cells, start, columns.mean, work.rate, u)
            if state.counts[0] == 0:
                first_frame(frames, columns.cells, start, width, u)
            measure_tile(u, begin, width, len(work.g), u, 0, work.g)
            measure_tile(v, column, padded, len(work.e), u, 0, work.e)
    if settle:
        work.shrink[:] = 1.0
    for j in range(work.e.shape[0]):
        for s in range(GROUP):
            work.e[j, s] *= work.shrink[j]
    return square
