"""Outputs of slow features on whole blocks of frames: y = phi (x - mean)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arithmetic.choice import Either
from cdmisfa.core.arithmetic.compiled import compiled, reordered
from cdmisfa.core.blocks import PIXEL, UINT8, as_frames
from cdmisfa.core.errors import UsageError
from cdmisfa.features.inner_products import ROWS, measure_tile

Float = NDArray[np.float64]

CHUNK = 512
"""Columns scaled at a time: 4 KB, so that they stay next to the arithmetic."""


def project(phi: Float, offset: Float, frames: Any) -> Float:
    """Output y = phi x - offset of every row of phi on every frame.

    Equation: 1

    Args:
        phi: (R, I) rows of one or more abstractions.
        offset: (R,) phi times the mean.
        frames: (n, I) values, or uint8 pixels, which count 1/255 each.

    Returns:
        (n, R).

    Raises:
        UsageError: these are no frames of I values, or phi and offset no weights of some rows.
    """
    phi, offset = np.asarray(phi, dtype=np.float64), np.asarray(offset, dtype=np.float64)
    if phi.ndim != 2 or offset.shape != phi.shape[:1]:
        raise UsageError(
            f"weights of shape {phi.shape} and offsets of {offset.shape} given: give (R, I), (R,)"
        )
    return outputs(phi, offset, as_frames(frames, phi.shape[1]))


@reordered
def _outputs(phi: Float, offset: Float, frames: NDArray[Any]) -> Float:
    """`project` for frames that were checked: compiled, and without a float copy of them.

    A row's output does not depend on which rows it is stacked with, nor a frame's on its
    block. Sums are reassociated (SIMD), hence may differ in the last digits across CPUs.

    Args:
        phi: (R, I) rows of one or more abstractions.
        offset: (R,) phi times the mean.
        frames: (n, I) as `as_frames` gives them.

    Returns:
        (n, R).
    """
    n, size = frames.shape
    rows = phi.shape[0]
    scale = PIXEL if frames.dtype == UINT8 else 1.0
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


@compiled
def _outputs_in_order(phi: Float, offset: Float, frames: NDArray[Any]) -> Float:
    """See `outputs`."""
    n, size = frames.shape
    rows = phi.shape[0]
    scale = PIXEL if frames.dtype == UINT8 else 1.0
    x, e = np.zeros((ROWS, CHUNK)), np.empty((rows, ROWS))
    y = np.empty((n, rows))
    for first in range(0, n, ROWS):
        count = min(ROWS, n - first)
        e[:] = 0.0
        for start in range(0, size, CHUNK):
            width = min(CHUNK, size - start)
            for k in range(count):
                for i in range(width):
                    x[k, i] = frames[first + k, start + i] * scale
            measure_tile(phi, start, width, rows, x, 0, e)
        for k in range(count):
            for r in range(rows):
                y[first + k, r] = e[r, k] - offset[r]
    return y


outputs: Callable[[Float, Float, NDArray[Any]], Float] = Either(_outputs, lambda: _outputs_in_order)
"""See `_outputs`."""


@compiled
def mean_output(phi: Float, mean: Float) -> Float:
    """What phi gives out on the mean input, (J,): the offset of a centred projection.

    Args:
        phi: (J, I) weights.
        mean: (I,) mean of the input.
    """
    offset = np.zeros(phi.shape[0])
    for j in range(phi.shape[0]):
        for i in range(phi.shape[1]):
            offset[j] += phi[j, i] * mean[i]
    return offset
