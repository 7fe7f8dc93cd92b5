"""Outputs of slow features on whole blocks of frames."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.compiled import reordered
from cdmisfa.features.incsfa.state import PIXEL, Float

CHUNK = 512
"""Columns scaled at a time: 4 KB, so that they stay next to the arithmetic."""


@reordered
def project(phi: Float, offset: Float, frames: NDArray[Any]) -> Float:
    """Output y = phi x - offset of every row of phi on every frame, without a float copy.

    A row's output does not depend on which rows it is stacked with, nor a frame's on its
    block. Sums are reassociated (SIMD), hence may differ in the last digits across CPUs.

    Equation: 1

    Args:
        phi: (R, I) rows of one or more abstractions.
        offset: (R,) phi times the mean.
        frames: (n, I) values, or uint8 pixels, which count 1/255 each.

    Returns:
        (n, R).
    """
    n, size = frames.shape
    rows = phi.shape[0]
    scale = PIXEL if frames.itemsize == 1 else 1.0
    x = np.empty(CHUNK)
    y = np.zeros((n, rows))
    for t in range(n):
        for start in range(0, size, CHUNK):
            width = min(CHUNK, size - start)
            frame = frames[t, start : start + width]
            for i in range(width):
                x[i] = frame[i] * scale
            for r in range(rows):
                total = 0.0
                weights = phi[r, start : start + width]
                for i in range(width):
                    total += x[i] * weights[i]
                y[t, r] += total
        for r in range(rows):
            y[t, r] -= offset[r]
    return y
