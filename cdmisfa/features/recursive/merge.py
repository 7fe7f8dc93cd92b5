"""The small part of recursive SFA: what a block does to the basis, in inner products alone.

The old basis, weighted by the variance along it, and the frames of the block are rows of one
matrix A; the new basis is that of its largest principal components. Of all rows the most
different ones are taken, by Cholesky decomposition of A A' with pivots, half as many again as
the basis has: on what they span the components are exact, and what is left out is smaller than
the least of them.

Source: incremental PCA with a moving mean, Ross et al. 2008.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arithmetic.compiled import compiled
from cdmisfa.features.recursive.eigen import eigen

Float = NDArray[np.float64]
Int = NDArray[np.int64]

RANK_TOLERANCE = 1e-8
"""Share of the largest variance below which a direction is left out as rounding noise."""


class Merge(NamedTuple):
    """How a new basis is made, and what it sees of the old one and of the block.

    P rows are used, of the old basis and of the block, k directions come out.

    Attributes:
        old: rows of the old basis in use.
        chosen: frames of the block in use.
        weights: (k, P + 1) of these rows and of the block's mean.
        variance: (k,) along the new directions.
        turn: (k, L) new basis times old basis.
        frames: (k, n) new basis times the frames, as measured.
    """

    old: Int
    chosen: Int
    weights: Float
    variance: Float
    turn: Float
    frames: Float


@compiled
def multiply(a: Float, b: Float) -> Float:
    """A b, with inner loops along memory."""
    out = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        row = out[i]
        for k in range(a.shape[1]):
            share, other = a[i, k], b[k]
            for j in range(b.shape[1]):
                row[j] += share * other[j]
    return out


@compiled
def transposed(a: Float) -> Float:
    """A' with its own rows along memory."""
    out = np.empty((a.shape[1], a.shape[0]))
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            out[j, i] = a[i, j]
    return out


@compiled
def columns(a: Float, start: int, stop: int, rows: int) -> Float:
    """Columns [start, stop) of the first rows of A, for themselves in memory."""
    out = np.empty((rows, stop - start))
    for i in range(rows):
        for j in range(start, stop):
            out[i, j - start] = a[i, j]
    return out


@compiled
def gram_of_rows(variance: Float, seen: float, e: Float, g: Float, m: int) -> Float:
    """A A' of the weighted old basis and the block's frames.

    The frames are taken less the part of their mean that the old mean already explains, so
    that their scatter about the new mean comes out.

    Args:
        variance: (L,) along the old basis.
        seen: frames that the old basis stands for.
        e: (L, n) basis times frames, see `measure`.
        g: (n, n) frames times frames.
        m: frames of the block, in columns [1, m + 1).

    Returns:
        (L + m, L + m).
    """
    rank = len(variance)
    moved = 1.0 - np.sqrt(seen / (seen + m))
    e_mean, g_mean, mean_square = np.zeros(rank), np.zeros(m), 0.0
    for t in range(m):
        for j in range(rank):
            e_mean[j] += e[j, t + 1] / m
        for s in range(m):
            g_mean[s] += g[s + 1, t + 1] / m
    for t in range(m):
        mean_square += g_mean[t] / m
    out = np.zeros((rank + m, rank + m))
    for j in range(rank):
        out[j, j] = seen * variance[j]
        weight = np.sqrt(out[j, j])
        for t in range(m):
            out[j, rank + t] = weight * (e[j, t + 1] - moved * e_mean[j])
            out[rank + t, j] = out[j, rank + t]
    for s in range(m):
        for t in range(m):
            both = g_mean[s] + g_mean[t] - moved * mean_square
            out[rank + s, rank + t] = g[s + 1, t + 1] - moved * both
    return out


@compiled
def pivoted_cholesky(gram: Float, most: int, floor: float) -> tuple[Int, Float]:
    """The rows that differ most, and what they explain of all others.

    Args:
        gram: (r, r) inner products of the rows.
        most: how many to take at most.
        floor: end where no row has more than this left to explain.

    Returns:
        (p,) their indices, in the order taken, and (p, r) F with F' F equal to gram on their span.
    """
    r = len(gram)
    factor, pivots, left = (
        np.zeros((min(most, r), r)),
        np.zeros(min(most, r), np.int64),
        np.empty(r),
    )
    for i in range(r):
        left[i] = gram[i, i]
    floor = max(floor, RANK_TOLERANCE * 1e-2 * left[_largest(left)])
    count = 0
    while count < len(pivots):
        pivot = _largest(left)
        if not left[pivot] > floor:
            break
        row, root = factor[count], np.sqrt(left[pivot])
        for i in range(r):
            row[i] = gram[pivot, i]
        for k in range(count):
            share, other = factor[k, pivot], factor[k]
            for i in range(r):
                row[i] -= share * other[i]
        for i in range(r):
            row[i] /= root
            left[i] -= row[i] * row[i]
        row[pivot] = root
        pivots[count] = pivot
        count += 1
        for k in range(count):
            left[pivots[k]] = 0.0
        for k in range(count - 1):
            row[pivots[k]] = 0.0
    return pivots[:count], factor[:count]


@compiled
def _largest(values: Float) -> int:
    """Index of the first of the largest values, and of the first NaN where there is one."""
    largest = 0
    for i in range(1, len(values)):
        if not (values[i] <= values[largest] or math.isnan(values[largest])):
            largest = i
    return largest


@compiled
def merge(
    variance: Float, seen: float, e: Float, g: Float, m: int, size: int, floor: float
) -> Merge:
    """The new basis.

    Args:
        variance: (L,) see `gram_of_rows`, as the next four.
        seen: frames that the old basis stands for.
        e: (L, n).
        g: (n, n).
        m: frames of the block.
        size: directions at most.
        floor: sum of squares along a direction below which it is rounding noise.
    """
    rank, n = len(variance), len(g)
    pivots, factor = pivoted_cholesky(
        gram_of_rows(variance, seen, e, g, m), size + size // 2, floor
    )
    p = len(pivots)
    rows = transposed(factor)
    values, vectors = np.zeros(p), np.zeros((p, p))
    eigen(multiply(factor, rows), values, vectors)
    k = 0
    while k < min(size, p) and values[k] > max(floor, RANK_TOLERANCE * values[0]):
        k += 1
    by_row = np.zeros((p, k))  # solves by_row' rows[pivots] = vectors, from the last row on
    for i in range(p - 1, -1, -1):
        own = by_row[i]
        for j in range(k):
            own[j] = vectors[j, i]
        for q in range(i + 1, p):
            share, other = rows[pivots[q], i], by_row[q]
            for j in range(k):
                own[j] -= share * other[j]
        for j in range(k):
            own[j] /= rows[pivots[i], i]
    of_old = 0
    for i in range(p):
        if pivots[i] < rank:
            of_old += 1
    old, chosen = np.empty(of_old, np.int64), np.empty(p - of_old, np.int64)
    weights, parts = np.zeros((k, p + 1)), np.zeros((p + 1, rank + n))
    moved = 1.0 - np.sqrt(seen / (seen + m))
    a, b = 0, of_old
    for i in range(p):
        pivot = pivots[i]
        if pivot < rank:
            old[a] = pivot
            weight = np.sqrt(seen * variance[pivot])
            for j in range(k):
                weights[j, a] = by_row[i, j] * weight
            parts[a, pivot] = 1.0
            for s in range(n):
                parts[a, rank + s] = e[pivot, s]
            a += 1
        else:
            frame = pivot - rank
            chosen[b - of_old] = frame
            for j in range(k):
                weights[j, b] = by_row[i, j]
                weights[j, p] -= moved * by_row[i, j]
            for j in range(rank):
                parts[b, j] = e[j, frame + 1]
            for s in range(n):
                parts[b, rank + s] = g[frame + 1, s]
            b += 1
    for t in range(1, m + 1):
        for j in range(rank):
            parts[p, j] += e[j, t] / m
        for s in range(n):
            parts[p, rank + s] += g[t, s] / m
    seen_by = multiply(weights, parts)
    turn, frames = columns(seen_by, 0, rank, k), columns(seen_by, rank, rank + n, k)
    new = np.empty(k)
    for i in range(k):
        new[i] = values[i] / (seen + m)
    return Merge(old, chosen, weights, new, turn, frames)
