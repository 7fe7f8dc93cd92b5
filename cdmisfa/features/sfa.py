"""Batch slow feature analysis, the reference for incremental results.

Source: Wiskott and Sejnowski 2002.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray, as_frames


def batch_sfa(frames: NDArray[Any], outputs: int, *, tolerance: float = 1e-10) -> FloatArray:
    """Return the slowest linear features of unit variance, the slowest first.

    Args:
        frames: (n, I) consecutive frames, uint8 or float64; pixels are not scaled.
        outputs: number of features J.
        tolerance: directions with less than this share of the largest variance hold rounding
            noise and are left out.

    Returns:
        (J, I) weights of the centred frame.

    Raises:
        UsageError: the array is not one of frames.
        ValueError: the frames vary in fewer than J directions.
    """
    x = as_frames(frames).astype(np.float64)
    x -= x.mean(axis=0)
    _, deviation, directions = np.linalg.svd(x / np.sqrt(len(x)), full_matrices=False)
    used = deviation**2 > tolerance * deviation[0] ** 2
    if used.sum() < outputs:
        raise ValueError(f"frames vary in {used.sum()} directions: ask for fewer than {outputs}")
    whitening = directions[used] / deviation[used, None]
    change = np.diff(x @ whitening.T, axis=0)
    _, rotation = np.linalg.eigh(change.T @ change / len(change))
    return np.asarray(rotation[:, :outputs].T @ whitening)


def slowness(y: FloatArray) -> FloatArray:
    """Return the slowness of each output of a sequence; smaller is slower.

    Equation: 2

    Args:
        y: (n, J) outputs of consecutive frames.

    Returns:
        (J,) sqrt(E(ydot^2) / Var(y)) / (2 pi), in cycles a frame.
    """
    change = np.diff(y, axis=0)
    return np.asarray(np.sqrt((change**2).mean(axis=0) / y.var(axis=0)) / (2 * np.pi))
