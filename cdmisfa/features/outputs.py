"""Outputs of slow features, y = phi (x - mean), and their slowness."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from cdmisfa import kernels
from cdmisfa.core.arrays import FloatArray


def project(phi: FloatArray, offset: FloatArray, frames: Any) -> FloatArray:
    """Return the outputs y = phi x - offset of weights on frames.

    The output of a row of phi does not depend on the other rows, nor that of a frame on the other
    frames.

    Equation: 1

    Args:
        phi: (R, I) weights of one or more modules.
        offset: (R,) outputs on the mean of the frames.
        frames: (n, I) values, or uint8 pixels, which count 1/255 each.

    Returns:
        (n, R) outputs.

    Raises:
        UsageError: the frames or the offset have a different shape or type.
    """
    phi, offset = np.asarray(phi, dtype=np.float64), np.asarray(offset, dtype=np.float64)
    return kernels.outputs(phi, offset, frames)


def slowness_by_moments(derivative_square: Any, variance: Any) -> FloatArray:
    """Return the slowness (cycles a frame) for E(ydot^2) and Var(y); infinite without variance."""
    with np.errstate(all="ignore"):
        slowness = np.sqrt(np.divide(derivative_square, variance)) / (2.0 * math.pi)
        return np.where(np.asarray(variance) <= 0, math.inf, slowness)


def window_rate(window: float, count: int) -> float:
    """Return the rate of an exponential mean over `window` samples that begins as a plain mean."""
    return max(2.0 / (window + 1.0), 1.0 / count)
