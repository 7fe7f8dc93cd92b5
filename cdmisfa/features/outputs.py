"""Outputs of slow features, y = phi (x - mean), and what tells how slow they are."""

from __future__ import annotations

from typing import Any

import numpy as np

from cdmisfa import kernels
from cdmisfa.core.arrays import FloatArray


def project(phi: FloatArray, offset: FloatArray, frames: Any) -> FloatArray:
    """Output y = phi x - offset of every row of phi on every frame.

    A row's output does not depend on which rows it is stacked with, nor a frame's on its block.

    Equation: 1

    Args:
        phi: (R, I) rows of one or more abstractions.
        offset: (R,) phi times the mean.
        frames: (n, I) values, or uint8 pixels, which count 1/255 each.

    Returns:
        (n, R).

    Raises:
        UsageError: these are no frames of I values, or there are not R offsets.
    """
    phi, offset = np.asarray(phi, dtype=np.float64), np.asarray(offset, dtype=np.float64)
    return kernels.outputs(phi, offset, frames)


def slowness_by_moments(derivative_square: float, variance: float) -> float:
    """Slowness in 1/frame from E(ydot^2) and Var(y); infinite where there is no variance."""
    return float(kernels.lib.slowness(derivative_square, variance))


def window_rate(window: float, count: int) -> float:
    """Rate of an exponential mean over `window` samples that starts as a plain mean."""
    return max(2.0 / (window + 1.0), 1.0 / count)
