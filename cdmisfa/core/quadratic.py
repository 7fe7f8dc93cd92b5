"""The quadratic expansion, compiled; its entry among all of them is in `expansion`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.compiled import compiled
from cdmisfa.core.frames import PIXEL, UINT8


@compiled
def inputs_and_products(frames: NDArray[Any]) -> NDArray[np.float64]:
    """All inputs, then all products of two: (x1, x2, x1^2, x1 x2, x2^2) for two inputs.

    Args:
        frames: (n, I) as `as_frames` gives them.

    Returns:
        (n, I + I (I + 1) / 2).
    """
    n, size = frames.shape
    scale = PIXEL if frames.dtype == UINT8 else 1.0
    out = np.empty((n, size + size * (size + 1) // 2))
    for t in range(n):
        for i in range(size):
            out[t, i] = frames[t, i] * scale
        column = size
        for i in range(size):
            for j in range(i, size):
                out[t, column] = out[t, i] * out[t, j]
                column += 1
    return out
