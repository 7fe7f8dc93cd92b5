"""Slowness of a signal: over everything seen, within a block, and whether it settled.

All functions are compiled; moments are per frame, so slowness is in cycles per frame.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arithmetic.compiled import compiled

Float = NDArray[np.float64]


@compiled
def slowness(derivative_square: float, variance: float) -> float:
    """Eta of a signal from E(ydot^2) and Var(y), in cycles per frame; smaller is slower.

    White noise has 0.2251. A signal without variance has no slowness: infinity.

    Equation: 2
    """
    if variance <= 0.0:
        return math.inf
    return math.sqrt(derivative_square / variance) / (2.0 * math.pi)


@compiled
def block_moments(y: Float) -> tuple[float, float, float]:
    """Mean, mean square and mean squared derivative of one output over a block.

    Args:
        y: (n,) output; the derivative is the difference of neighbouring frames, so it has
            n - 1 values.
    """
    n = len(y)
    total = 0.0
    square = 0.0
    derivative = 0.0
    for k in range(n):
        total += y[k]
        square += y[k] * y[k]
        if k > 0:
            derivative += (y[k] - y[k - 1]) ** 2
    return total / n, square / n, derivative / max(n - 1, 1)


@compiled
def instantaneous_slowness(y: Float) -> float:
    """Eta of one output from the frames of one block only, in cycles per frame.

    Args:
        y: (n,) output over the block.

    Equation: 4
    """
    mean, _, derivative = block_moments(y)
    return slowness(derivative, block_variance(y, mean))


@compiled
def block_variance(y: Float, mean: float) -> float:
    """Variance of one output over a block, about its mean there.

    Args:
        y: (n,) output over the block.
        mean: as `block_moments` has it.
    """
    variance = 0.0
    for k in range(len(y)):
        variance += (y[k] - mean) ** 2
    return variance / len(y)


@compiled
def converged(eta_dot: Float, delta: float) -> bool:
    """Whether the slowness of every output has stopped changing.

    Args:
        eta_dot: (J,) running mean of the absolute change of eta.
        delta: threshold of the paper.

    Equation: 3
    """
    for j in range(len(eta_dot)):
        if not abs(eta_dot[j]) < delta:
            return False
    return True


@compiled
def window_rate(window: float, count: int) -> float:
    """Rate of an exponential mean over `window` samples that starts as a plain mean."""
    return max(2.0 / (window + 1.0), 1.0 / count)
