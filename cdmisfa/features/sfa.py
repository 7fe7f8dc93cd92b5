"""Batch slow feature analysis: the oracle incremental results are compared with.

Source: Wiskott and Sejnowski 2002.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray, as_frames


def batch_sfa(frames: NDArray[Any], outputs: int, *, tolerance: float = 1e-10) -> FloatArray:
    """Slowest linear features of unit variance, slowest first.

    Directions whose variance is below `tolerance` times the largest are left out, as
    they hold rounding noise.

    Args:
        frames: (n, I) consecutive frames, uint8 or float64, of which each counts as it is.
        outputs: J, how many features.
        tolerance: least share of the largest variance.

    Returns:
        (J, I) weights of the centred frame.

    Raises:
        UsageError: these are no frames.
        ValueError: they vary in fewer than J directions.
    """
    x = as_frames(frames).astype(np.float64)
    x -= x.mean(axis=0)
    _, deviation, directions = np.linalg.svd(x / np.sqrt(len(x)), full_matrices=False)
    kept = deviation**2 > tolerance * deviation[0] ** 2
    if kept.sum() < outputs:
        raise ValueError(f"{outputs} features asked of frames that vary in {kept.sum()} directions")
    whitening = directions[kept] / deviation[kept, None]
    change = np.diff(x @ whitening.T, axis=0)
    _, rotation = np.linalg.eigh(change.T @ change / len(change))
    return np.asarray(rotation[:, :outputs].T @ whitening)


def slowness(y: FloatArray) -> FloatArray:
    """Slowness of each output over a whole sequence; smaller is slower.

    Equation: 2

    Args:
        y: (n, J) outputs of consecutive frames.

    Returns:
        (J,) in 1/frame: sqrt(E(ydot^2) / Var(y)) / (2 pi).
    """
    change = np.diff(y, axis=0)
    return np.asarray(np.sqrt((change**2).mean(axis=0) / y.var(axis=0)) / (2 * np.pi))
