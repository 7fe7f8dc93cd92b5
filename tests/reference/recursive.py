"""Recursive SFA as one writes it in numpy: what the kernels must come to, but for rounding."""

from __future__ import annotations

import numpy as np

from cdmisfa.core.arrays import FloatArray
from cdmisfa.features.recursive import PIECE, RecursiveState


def most_different(rows: FloatArray, most: int, least: float) -> FloatArray:
    """An orthonormal basis of the rows that differ most from those chosen before, (P, I)."""
    left, span = rows.copy(), np.zeros((0, rows.shape[1]))
    least = max(least, 1e-10 * (rows**2).sum(axis=1).max())
    while len(span) < most:
        squares = (left**2).sum(axis=1)
        largest = squares.argmax()
        if not squares[largest] > least:
            break
        own = left[largest] - (left[largest] @ span.T) @ span
        own /= np.sqrt(own @ own)
        span, left = np.vstack([span, own]), left - np.outer(left @ own, own)
    return span


def eigen(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Eigenvalues, the largest first, and eigenvectors as rows."""
    values, vectors = np.linalg.eigh(matrix)
    return values[::-1], vectors.T[::-1]


def learn_piece(
    state: RecursiveState, x: FloatArray, gap: bool, window: int, wide: int, principal: int
) -> float:
    """Take in a piece of a block (m, I) of values; the change of the slowest output."""
    rank, seen, pairs = state.counts.tolist()
    size, (m, _) = len(state.variance), x.shape
    if not seen:
        state.mean[:] = x[0]
    basis, u = state.basis[:rank].copy(), x - state.mean
    moved = 1 - np.sqrt(seen / (seen + m))
    weighted = np.sqrt(seen * state.variance[:rank, None]) * basis
    rows = np.vstack([weighted, u - moved * u.mean(axis=0)])
    least = 1e-28 * (state.mean @ state.mean) * (seen + m)
    span = most_different(rows, min(size + min(size // 2, 16), len(rows)), least)
    squares, vectors = eigen((rows @ span.T).T @ (rows @ span.T))
    k = int((squares > max(least, 1e-8 * squares.max(initial=0.0)))[:size].sum())
    new, variance = vectors[:k] @ span, squares[:k] / (seen + m)
    turn = new @ basis.T
    steps = np.diff(x if gap or not seen else np.vstack([state.last, x]), axis=0) @ new.T
    total = pairs * (turn @ state.differences[:rank, :rank] @ turn.T) + steps.T @ steps
    before = state.weights[:, :rank] @ turn.T
    state.mean[:] += u.mean(axis=0) * m / (seen + m)
    state.last[:] = x[-1]
    state.basis[:k] = new
    for array in (state.variance, state.differences, state.weights):
        array[...] = 0.0
    state.variance[:k] = variance
    state.differences[:k, :k] = total / max(pairs + len(steps), 1)
    state.counts[:] = k, min(seen + m, window), min(pairs + len(steps), window)
    solve(state, k, wide, principal)
    return change(state.weights[:, :k], before, variance)


def solve(state: RecursiveState, rank: int, wide: int, principal: int) -> None:
    """The outputs: least difference among whitened components, and principal components."""
    k, slow = min(rank, len(state.spectrum)), len(state.weights) - principal
    scale = 1 / np.sqrt(state.variance[:rank])
    whitened = scale[:, None] * state.differences[:rank, :rank] * scale
    values, vectors = eigen(whitened[:k, :k])
    state.spectrum[:] = np.nan
    state.spectrum[:k] = np.sqrt(np.maximum(values[::-1], 0.0)) / (2 * np.pi)
    shown = vectors[::-1][:slow]
    state.weights[: len(shown), :k] = shown * scale[:k]
    if min(wide, rank) > k:
        first = np.pad(shown[0], (0, min(wide, rank) - k))
        rest = np.linalg.svd(first[None])[2][1:]  # directions of no correlation with the first
        _, vectors = eigen(rest @ whitened[: len(first), : len(first)] @ rest.T)
        shown = (vectors[::-1] @ rest)[: slow - 1]
        state.weights[1 : len(shown) + 1, : len(first)] = shown * scale[: len(first)]
    for i in range(min(principal, rank)):
        state.weights[slow + i, i] = scale[i]


def change(weights: FloatArray, before: FloatArray, variance: FloatArray) -> float:
    """Change of the slowest output, from its correlation with the one before."""
    power = float((before[0] ** 2 * variance).sum())
    if not power:
        return float("nan")
    rho = abs(float((before[0] * variance) @ weights[0])) / np.sqrt(power)
    return float(np.sqrt(max(0.0, 2 - 2 * rho)))


def update(
    state: RecursiveState,
    frames: FloatArray,
    gap: bool,
    window: int,
    wide: int = 0,
    principal: int = 0,
) -> FloatArray:
    """Learn from consecutive frames of values; what `RecursiveFeature.update` returns."""
    out = np.full(len(frames), np.nan)
    for start in range(0, len(frames), PIECE):
        piece = frames[start : start + PIECE]
        how = gap and start == 0, window, wide, principal
        out[start + len(piece) - 1] = learn_piece(state, piece, *how)
    return out
