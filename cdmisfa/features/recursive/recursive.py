"""`RecursiveSFA`: the slowest outputs of all frames so far, exactly and without a learning rate.

Kept are the largest principal components of the frames and the covariance of the differences
of consecutive frames along them, each over an exponential window. The slow features are the
directions of least derivative among the whitened components: a small eigenvalue problem, solved
anew for every block. Outputs have unit variance, whatever the units of the frames.

Sources: incremental PCA: Ross et al. 2008; SFA as an eigenvalue problem: Wiskott and Sejnowski
2002; recursive forms: Kompella et al. 2012, Liwicki et al. 2015.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arithmetic.compiled import compiled
from cdmisfa.core.blocks import PIXEL, UINT8, as_frames
from cdmisfa.core.errors import UsageError
from cdmisfa.features.inner_products import ROWS
from cdmisfa.features.projection import outputs
from cdmisfa.features.recursive.eigen import eigen
from cdmisfa.features.recursive.merge import columns, merge, multiply, transposed
from cdmisfa.features.recursive.passes import measure, rebuild

Float = NDArray[np.float64]
Int = NDArray[np.int64]

PIECE = 64
"""Frames taken in at once; longer blocks are cut into pieces of so many."""

ROUNDING = 1e-14
"""Share of a value below which its differences are rounding noise."""

_TINY = 1e-300


class State(NamedTuple):
    """Everything that changes: I inputs, L directions, K whitened components, J outputs.

    Attributes:
        mean: (I,) mean of the frames.
        basis: (L, I) orthonormal directions, those of the largest variance first.
        variance: (L,) along them.
        differences: (L, L) mean square of the differences of consecutive frames along them.
        weights: (J, L) the slow features as weights of the directions.
        spectrum: (K,) slowness of all slow features, the slowest first; NaN where there is none.
        last: (I,) the last frame.
        counts: (3,) directions in use; frames in `mean` and `variance`; differences in
            `differences`. The latter two stop at the window.
    """

    mean: Float
    basis: Float
    variance: Float
    differences: Float
    weights: Float
    spectrum: Float
    last: Float
    counts: Int


@compiled
def advance(state: State, frames: NDArray[Any], scale: float, gap: bool, window: int) -> float:
    """Learn from a piece of a block.

    Args:
        state: changed in place.
        frames: (m, I) consecutive frames, m >= 1.
        scale: 1 for values, 1/255 for pixels.
        gap: they do not follow the frames before.
        window: frames of the exponential window.

    Returns:
        Change of the outputs, see `RecursiveSFA.update`.
    """
    rank, seen, pairs = state.counts[0], state.counts[1], state.counts[2]
    m, size = len(frames), len(state.variance)
    if seen == 0:
        for i in range(len(state.mean)):
            state.mean[i] = frames[0, i] * scale
    n = (m + ROWS) // ROWS * ROWS
    e, g = np.zeros((size, n)), np.zeros((n, n))
    measure(state.basis, rank, frames, scale, state.last, state.mean, e, g)
    floor = 0.0
    for i in range(len(state.mean)):
        floor += (ROUNDING * state.mean[i]) ** 2
    floor *= seen + m
    done = merge(state.variance[:rank], float(seen), e, g, m, size, floor)
    rebuild(
        state.basis,
        done.old,
        frames,
        done.chosen,
        scale,
        state.mean,
        done.weights,
        m / (seen + m),
    )
    for i in range(len(state.last)):
        state.last[i] = frames[m - 1, i] * scale
    k = len(done.variance)
    first = 1 if gap or seen == 0 else 0
    count = m - first
    steps = np.empty((k, count))
    for i in range(k):
        for t in range(count):
            steps[i, t] = done.frames[i, first + t + 1] - done.frames[i, first + t]
    back = transposed(done.turn)
    turned = multiply(multiply(done.turn, columns(state.differences, 0, rank, rank)), back)
    new = multiply(steps, transposed(steps))
    share = 1.0 / max(pairs + count, 1)
    for i in range(size):
        state.variance[i] = done.variance[i] if i < k else 0.0
        for j in range(size):
            state.differences[i, j] = 0.0
    for i in range(k):
        for j in range(k):
            both = 0.5 * (turned[i, j] + turned[j, i])  # symmetric whatever rounding does
            state.differences[i, j] = share * (pairs * both + new[i, j])
    state.counts[0] = k
    state.counts[1] = min(seen + m, window)
    state.counts[2] = min(pairs + count, window)
    before = multiply(columns(state.weights, 0, rank, len(state.weights)), back)
    _slowest(state)
    return _align(state, before)


@compiled
def _slowest(state: State) -> None:
    """Solve for the slow features: least difference among the whitened components."""
    outputs, components = len(state.weights), len(state.spectrum)
    k = min(components, state.counts[0])
    scale, matrix = np.empty(k), np.empty((k, k))
    for i in range(k):
        scale[i] = 1.0 / np.sqrt(state.variance[i])
    for i in range(k):
        for j in range(k):
            matrix[i, j] = state.differences[i, j] * scale[i] * scale[j]
    values, vectors = np.zeros(k), np.zeros((k, k))
    eigen(matrix, values, vectors)
    for o in range(outputs):
        for i in range(state.weights.shape[1]):
            state.weights[o, i] = 0.0
    for o in range(components):
        state.spectrum[o] = np.nan
    for o in range(k):
        slow = k - 1 - o
        state.spectrum[o] = np.sqrt(max(values[slow], 0.0)) / (2.0 * np.pi)
        if o < outputs:
            for i in range(k):
                state.weights[o, i] = vectors[slow, i] * scale[i]


@compiled
def _align(state: State, before: Float) -> float:
    """Keep the signs that the outputs had, and say how much they changed.

    Equation: P1

    Args:
        state: with new weights.
        before: (J, k) the old weights, of the new directions.

    Returns:
        Change, see `RecursiveSFA.update`; NaN where there were no outputs before.
    """
    outputs, k = before.shape
    alike = np.zeros((outputs, outputs))
    for o in range(outputs):
        power = 0.0
        for j in range(k):
            power += before[o, j] ** 2 * state.variance[j]
        if power <= 0.0:
            return math.nan
        for p in range(outputs):
            for j in range(k):
                alike[o, p] += before[o, j] * state.weights[p, j] * state.variance[j]
            alike[o, p] /= np.sqrt(power)
        if alike[o, o] < 0.0:
            for i in range(state.weights.shape[1]):
                state.weights[o, i] *= -1.0
            for p in range(outputs):
                alike[p, o] *= -1.0
    values, vectors = np.zeros(outputs), np.zeros((outputs, outputs))
    eigen(multiply(alike, transposed(alike)), values, vectors)
    total = 0.0
    for o in range(outputs):
        total += np.sqrt(max(values[o], 0.0)) / outputs
    return math.sqrt(max(0.0, 2.0 - 2.0 * total))


class RecursiveSFA:
    """Slow feature analysis of all frames so far, in blocks.

    Where the frames have no more directions than are kept (twice `components`), nothing is
    left out and it does not matter how they are cut into calls, but for rounding.

    Args:
        n_inputs: I, values of a frame.
        components: K, principal components that are whitened; twice as many are kept.
        outputs: J.
        window: frames of the exponential window; the first so many all count the same.

    Attributes:
        state: every array it consists of.

    Example:
        >>> t = np.arange(2000.0)
        >>> sfa = RecursiveSFA(2, components=2)
        >>> change = sfa.update(np.stack([np.sin(t / 50) + np.sin(t), np.sin(t)], axis=1))
        >>> round(float(sfa.slowness * 2 * np.pi * 50), 2)
        1.0
    """

    def __init__(
        self, n_inputs: int, components: int, outputs: int = 1, window: int = 8000
    ) -> None:
        if n_inputs < 1 or not 1 <= outputs <= components or window < 1:
            raise UsageError(
                f"no SFA of {n_inputs} inputs, {components} components, {outputs} outputs and a "
                f"window of {window}: each is at least 1, and outputs at most components"
            )
        size = min(2 * components, n_inputs)
        components = min(components, n_inputs)
        self.window = window
        self.state = State(
            mean=np.zeros(n_inputs),
            basis=np.zeros((size, n_inputs)),
            variance=np.zeros(size),
            differences=np.zeros((size, size)),
            weights=np.zeros((min(outputs, components), size)),
            spectrum=np.full(components, np.nan),
            last=np.zeros(n_inputs),
            counts=np.zeros(3, np.int64),
        )

    def update(self, frames: NDArray[Any], gap: bool = False) -> Float:
        """Learn from consecutive frames.

        Args:
            frames: (n, I) uint8 pixels, which count 1/255 each, or float64 values.
            gap: the first frame does not follow the last one learned from.

        Returns:
            (n,): at the last frame of each piece, the change of the outputs: sqrt(2 - 2 |rho|)
            of their correlation rho with those before, from 0 to sqrt 2; NaN elsewhere, and
            where there were none before.

        Raises:
            UsageError: these are no frames of I values.
        """
        rows = as_frames(frames, len(self.state.mean))
        scale = PIXEL if rows.dtype == UINT8 else 1.0
        change = np.full(len(rows), np.nan)
        for start in range(0, len(rows), PIECE):
            piece = slice(start, min(start + PIECE, len(rows)))
            first = gap and start == 0
            change[piece.stop - 1] = advance(self.state, rows[piece], scale, first, self.window)
        return change

    @property
    def slowness(self) -> float:
        """Slowness of the slowest output on what was learned from, NaN where there is none."""
        return float(self.state.spectrum[0])

    @property
    def phi(self) -> Float:
        """Slow features as weights of the centred input, (J, I)."""
        return multiply(self.state.weights, self.state.basis)

    @property
    def mean(self) -> Float:
        """Mean of the input, (I,)."""
        return self.state.mean

    def compare(self, phi: Float) -> tuple[Float, Float, Float]:
        """Other outputs on what was learned from, without its frames.

        Args:
            phi: (R, I) their weights of the centred input.

        Returns:
            (R,) each: variance, slowness, and correlation with the slowest output, from 0 to 1.
        """
        rank = self.state.counts[0]
        q = outputs(self.state.basis[:rank], np.zeros(rank), as_frames(phi, len(self.state.mean)))
        own, variance = self.state.weights[0, :rank], self.state.variance[:rank]
        power = (q * q * variance).sum(axis=1)
        steps = ((q[:, :, None] * self.state.differences[:rank, :rank]).sum(axis=1) * q).sum(axis=1)
        least = np.maximum(power, _TINY)
        slowness = np.sqrt(np.maximum(steps, 0.0) / least) / (2.0 * np.pi)
        rho = np.abs((q * own * variance).sum(axis=1)) / np.sqrt(least)
        return power, slowness, np.minimum(rho, 1.0)
