"""Nonlinear expansion of the input, so that linear features of it are nonlinear ones."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.compiled import compiled


def expanded_size(kind: str, n_inputs: int) -> int:
    """Length of an expanded frame.

    Args:
        kind: "none" or "quadratic", as `learner.expansion`.
        n_inputs: length I of a frame.

    Raises:
        ValueError: there is no such expansion.
    """
    if kind == "none":
        return n_inputs
    if kind == "quadratic":
        return n_inputs + n_inputs * (n_inputs + 1) // 2
    raise ValueError(f"no expansion {kind!r}: there are none, quadratic")


@compiled
def quadratic(frames: NDArray[Any]) -> NDArray[np.float64]:
    """All inputs, then all products of two: (x1, x2, x1^2, x1 x2, x2^2) for two inputs.

    Args:
        frames: (n, I) values, or uint8 pixels, which count 1/255 each.

    Returns:
        (n, I + I (I + 1) / 2).
    """
    n, size = frames.shape
    scale = 1.0 / 255.0 if frames.itemsize == 1 else 1.0
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
