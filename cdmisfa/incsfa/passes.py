"""The parts of the Gram kernel that touch whole frames: passes over tiles of columns.

Four frames are applied to all CCIPCA vectors in one read and one write of them, and the
inner products with the next four frames are taken in the same pass.
"""

from __future__ import annotations

from typing import Any

from numba import njit
from numpy.typing import NDArray

from cdmisfa.incsfa.state import PIXEL, Float, mean_rate

GROUP = 4
"""Frames applied in one pass."""

TILE = 256
"""Columns of a tile: the residuals of a group and the next group are 16 KB, inside L1."""

_reordered = njit(cache=True, fastmath={"reassoc", "contract"})


@_reordered
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


@_reordered
def gram_tile(u: Float, start: int, g: Float) -> None:
    """Add a tile's share of the inner products of a group's frames.

    Args:
        u: (GROUP, I) centred frames.
        start: first column.
        g: (GROUP, GROUP), in place.
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


@_reordered
def apply_tile(
    v: Float, start: int, tile: Float, shrink: Float, gain: Float, take: Float, e: Float
) -> None:
    """Apply a group to all vectors in a tile and take their products with the next group.

    v_j <- v_j + gain_tj r_t; r_t <- r_t - take_tj v_j for each frame t; at last
    v_j <- shrink_j v_j.

    Args:
        v: (K, I) CCIPCA vectors, in place.
        start: first column.
        tile: (2 * GROUP * TILE,) flat: the residuals, then the next frames.
        shrink: (K,).
        gain: (K, GROUP).
        take: (K, GROUP).
        e: (K, GROUP) products with the next frames, added to.
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
        ea0 = ea1 = ea2 = ea3 = eb0 = eb1 = eb2 = eb3 = 0.0
        for i in range(width):
            x, y = va[i], vb[i]
            r = tile[i]
            x += ca0 * r
            r -= ga0 * x
            y += cb0 * r
            tile[i] = r - gb0 * y
            r = tile[TILE + i]
            x += ca1 * r
            r -= ga1 * x
            y += cb1 * r
            tile[TILE + i] = r - gb1 * y
            r = tile[2 * TILE + i]
            x += ca2 * r
            r -= ga2 * x
            y += cb2 * r
            tile[2 * TILE + i] = r - gb2 * y
            r = tile[3 * TILE + i]
            x += ca3 * r
            r -= ga3 * x
            y += cb3 * r
            tile[3 * TILE + i] = r - gb3 * y
            x *= pa
            y *= pb
            va[i] = x
            vb[i] = y
            u = tile[4 * TILE + i]
            ea0 += x * u
            eb0 += y * u
            u = tile[5 * TILE + i]
            ea1 += x * u
            eb1 += y * u
            u = tile[6 * TILE + i]
            ea2 += x * u
            eb2 += y * u
            u = tile[7 * TILE + i]
            ea3 += x * u
            eb3 += y * u
        e[j, 0] += ea0
        e[j, 1] += ea1
        e[j, 2] += ea2
        e[j, 3] += ea3
        e[j + 1, 0] += eb0
        e[j + 1, 1] += eb1
        e[j + 1, 2] += eb2
        e[j + 1, 3] += eb3
    if K % 2 == 1:
        j = K - 1
        va = v[j, start : start + width]
        pa = shrink[j]
        ca0, ca1, ca2, ca3 = gain[j, 0], gain[j, 1], gain[j, 2], gain[j, 3]
        ea0 = ea1 = ea2 = ea3 = 0.0
        for i in range(width):
            x = va[i]
            x += ca0 * tile[i] + ca1 * tile[TILE + i]
            x += ca2 * tile[2 * TILE + i] + ca3 * tile[3 * TILE + i]
            x *= pa
            va[i] = x
            ea0 += x * tile[4 * TILE + i]
            ea1 += x * tile[5 * TILE + i]
            ea2 += x * tile[6 * TILE + i]
            ea3 += x * tile[7 * TILE + i]
        e[j, 0] += ea0
        e[j, 1] += ea1
        e[j, 2] += ea2
        e[j, 3] += ea3


@_reordered
def apply_group(
    v: Float,
    mean: Float,
    u: Float,
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
        shrink: (K,) its steps, as the next two; see `apply_tile`.
        gain: (K, GROUP).
        take: (K, GROUP).
        tile: (2 * GROUP * TILE,) scratch.
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
        centre_tile(frames, first, count, start, mean, n, window, u_next)
        gram_tile(u_next, start, g_next)
        for s in range(GROUP):
            tile[s * TILE : s * TILE + width] = u[s, start : start + width]
            tile[(GROUP + s) * TILE : (GROUP + s) * TILE + width] = u_next[s, start : start + width]
        apply_tile(v, start, tile, shrink, gain, take, e_next)
