"""Slowness of a signal, over everything seen and within a block, and rates of running means.

Moments are per frame, so slowness is in cycles per frame.
"""

from __future__ import annotations

from cdmisfa import kernels
from cdmisfa.core.arrays import FloatArray


def slowness(derivative_square: float, variance: float) -> float:
    """Eta of a signal from E(ydot^2) and Var(y); infinite where it has no variance."""
    return float(kernels.lib.slowness(derivative_square, variance))


def instantaneous_slowness(y: FloatArray) -> FloatArray:
    """Eta of each output from the frames of one block only, (J,).

    Args:
        y: (n, J) outputs over the block.
    """
    return kernels.instantaneous_slowness(y)


def window_rate(window: float, count: int) -> float:
    """Rate of an exponential mean over `window` samples that starts as a plain mean."""
    return max(2.0 / (window + 1.0), 1.0 / count)
