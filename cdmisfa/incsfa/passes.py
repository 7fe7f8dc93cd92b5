"""The parts of the Gram kernel that touch whole frames: passes over tiles of columns.

Four frames are applied to all CCIPCA vectors in one read and one write of them, and the
inner products with the next four frames are taken in the same pass.
"""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from cdmisfa.compiled import reordered
from cdmisfa.incsfa.state import PIXEL, Float, mean_rate

GROUP = 4
"""Frames applied in one pass."""

TILE = 256
"""Columns of a tile: the residuals of a group and the next group are 16 KB, half of L1."""

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
        u: (GROUP, I) receives the centred frames; rows beyond `count` become 0.
    """
    stop = min(start + TILE, mean.shape[0])
    scale = PIXEL if frames.itemsize == 1 else 1.0
    for s in range(GROUP):
        if s >= count:
            for i in range(start, stop):
                u[s, i] = 0.0
            continue
        rate = mean_rate(n + s + 1, window)
        offset = 0.0 if n + s == 0 else 1.0
        row, us, m = frames[first + s, start:stop], u[s, start:stop], mean[start:stop]
        for i in range(stop - start):
            x = row[i] * scale
            m[i] += rate * (x - m[i])
            us[i] = x - offset * m[i]


@reordered
def gram_tile(u: Float, start: int, g: Float) -> None:
    """Add a tile's share of the inner products of vectors with each other.

    Args:
        u: (K, I) vectors.
        start: first column.
        g: (K, K), in place.
    """
    stop = min(start + TILE, u.shape[1])
    for s in range(u.shape[0]):
        for t in range(s + 1):
            total = 0.0
            us, ut = u[s, start:stop], u[t, start:stop]
            for i in range(stop - start):
                total += us[i] * ut[i]
            g[s, t] += total
            g[t, s] = g[s, t]


@reordered
def apply_tile(v: Float, start: int, r: Float, shrink: Float, gain: Float, take: Float) -> None:
    """Apply a group's steps to all vectors in a tile of columns.

    v_j <- v_j + gain_tj r_t; r_t <- r_t - take_tj v_j for each frame t; at last
    v_j <- shrink_j v_j. Two vectors at a time, so that each residual is loaded half as often.

    Args:
        v: (K, I) CCIPCA vectors, in place.
        start: first column.
        r: (GROUP * TILE,) the group's frames in the tile, flat; overwritten.
        shrink: (K,).
        gain: (K, GROUP).
        take: (K, GROUP).
    """
    K, size = v.shape
    width = min(TILE, size - start)
    for j in range(0, K - 1, 2):
        va, vb = v[j, start : start + width], v[j + 1, start : start + width]
        pa, pb = shrink[j], shrink[j + 1]
        ca0, ca1, ca2, ca3 = gain[j, 0], gain[j, 1], gain[j, 2], gain[j, 3]
        cb0, cb1, cb2, cb3 = gain[j + 1, 0], gain[j + 1, 1], gain[j + 1, 2], gain[j + 1, 3]
        ga0, ga1, ga2, ga3 = take[j, 0], take[j, 1], take[j, 2], take[j, 3]
        gb0, gb1, gb2, gb3 = take[j + 1, 0], take[j + 1, 1], take[j + 1, 2], take[j + 1, 3]
        for i in range(width):
            x, y = va[i], vb[i]
            rest = r[i]
            x += ca0 * rest
            rest -= ga0 * x
            y += cb0 * rest
            r[i] = rest - gb0 * y
            rest = r[TILE + i]
            x += ca1 * rest
            rest -= ga1 * x
            y += cb1 * rest
            r[TILE + i] = rest - gb1 * y
            rest = r[2 * TILE + i]
            x += ca2 * rest
            rest -= ga2 * x
            y += cb2 * rest
            r[2 * TILE + i] = rest - gb2 * y
            rest = r[3 * TILE + i]
            x += ca3 * rest
            rest -= ga3 * x
            y += cb3 * rest
            r[3 * TILE + i] = rest - gb3 * y
            va[i] = x * pa
            vb[i] = y * pb
    if K % 2 == 1:
        j = K - 1
        va, pa = v[j, start : start + width], shrink[j]
        ca0, ca1, ca2, ca3 = gain[j, 0], gain[j, 1], gain[j, 2], gain[j, 3]
        for i in range(width):
            x = va[i] + ca0 * r[i] + ca1 * r[TILE + i]
            x += ca2 * r[2 * TILE + i] + ca3 * r[3 * TILE + i]
            va[i] = x * pa


@reordered
def measure_tile(v: Float, start: int, u: Float, e: Float) -> None:
    """Add a tile's share of the inner products of all vectors with a group's frames.

    Args:
        v: (K, I) CCIPCA vectors.
        start: first column.
        u: (GROUP, I) centred frames.
        e: (K, GROUP), in place.
    """
    K, size = v.shape
    width = min(TILE, size - start)
    u0, u1 = u[0, start : start + width], u[1, start : start + width]
    u2, u3 = u[2, start : start + width], u[3, start : start + width]
    for j in range(0, K, 2):
        # An odd last vector is measured together with the one before, and counted once.
        a = min(j, max(K - 2, 0))
        b = min(a + 1, K - 1)
        va, vb = v[a, start : start + width], v[b, start : start + width]
        ea0 = ea1 = ea2 = ea3 = eb0 = eb1 = eb2 = eb3 = 0.0
        for i in range(width):
            x, y = va[i], vb[i]
            ea0 += x * u0[i]
            eb0 += y * u0[i]
            ea1 += x * u1[i]
            eb1 += y * u1[i]
            ea2 += x * u2[i]
            eb2 += y * u2[i]
            ea3 += x * u3[i]
            eb3 += y * u3[i]
        if a == j:
            e[a, 0] += ea0
            e[a, 1] += ea1
            e[a, 2] += ea2
            e[a, 3] += ea3
        if b > j or a < j:
            e[b, 0] += eb0
            e[b, 1] += eb1
            e[b, 2] += eb2
            e[b, 3] += eb3


@reordered
def apply_group(
    v: Float,
    mean: Float,
    u: Float,
    applied: int,
    shrink: Float,
    gain: Float,
    take: Float,
    tile: Float,
    frames: NDArray[Any],
    first: int,
    count: int,
    n: int,
    window: float,
    u_next: Float,
    g_next: Float,
    e_next: Float,
) -> None:
    """Apply a group to the vectors, and centre and measure the next one, in one pass.

    Args:
        v: (K, I) CCIPCA vectors, in place.
        mean: (I,) running mean, in place.
        u: (GROUP, I) the group's centred frames.
        applied: how many frames it has; with 0 the vectors stay.
        shrink: (K,) its steps, as the next two; see `apply_tile`.
        gain: (K, GROUP).
        take: (K, GROUP).
        tile: (GROUP * TILE,) scratch.
        frames: (n, I) values or pixels.
        first: index of the next group's first frame.
        count: frames of the next group, 0 if there is none.
        n: number of frames seen before the next group.
        window: frames of the running mean.
        u_next: (GROUP, I) receives the next group's centred frames.
        g_next: (GROUP, GROUP) receives their inner products.
        e_next: (K, GROUP) receives theirs with the vectors.
    """
    size = v.shape[1]
    g_next[:] = 0.0
    e_next[:] = 0.0
    for start in range(0, size, TILE):
        width = min(TILE, size - start)
        if applied > 0:
            for s in range(GROUP):
                tile[s * TILE : s * TILE + width] = u[s, start : start + width]
            apply_tile(v, start, tile, shrink, gain, take)
        if count > 0:
            centre_tile(frames, first, count, start, mean, n, window, u_next)
            measure_tile(u_next, start, u_next, g_next)
            measure_tile(v, start, u_next, e_next)
