"""The gating system: is a block novel, and is the abstraction ready to be saved?"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.compiled import compiled
from cdmisfa.slowness import instantaneous_slowness

Float = NDArray[np.float64]

CONSTANT_VARIANCE = 1e-12
"""A block in which no input varies more than this carries nothing to learn."""

BAND = 2.0
"""Half width of a module's band of known slowness, in standard deviations (paper)."""

NOVEL = 0
"""Verdict: no frozen module knows the block. Positive verdicts are the module's index."""

CONSTANT = -1
"""Verdict: the block carries nothing to learn."""


@compiled
def is_constant(frames: NDArray[Any], scale: float) -> bool:
    """Whether no input of a block varies by more than CONSTANT_VARIANCE.

    Args:
        frames: (n, I) frames as they came.
        scale: factor from a frame's values to the learner's (1/255 for pixels).
    """
    n, inputs = frames.shape
    suspect = False
    for k in range(1, n):
        for i in range(inputs):
            if frames[k, i] != frames[0, i]:
                suspect = True
                break
        if suspect:
            break
    if not suspect:
        return True
    for i in range(inputs):
        origin = float(frames[0, i])
        mean = 0.0
        square = 0.0
        for k in range(n):
            difference = (float(frames[k, i]) - origin) * scale
            mean += difference
            square += difference * difference
        mean /= n
        if square / n - mean * mean > CONSTANT_VARIANCE:
            return False
    return True


@compiled
def verdict(y_frozen: Float, band_mean: Float, band_sd: Float, eta_inst: Float) -> int:
    """Index of the first frozen module that knows a block (from 1), or NOVEL.

    A module knows a block when the instantaneous slowness of every output lies within two
    standard deviations of its band's centre.

    Args:
        y_frozen: (M, n, J) outputs of the frozen modules on the block.
        band_mean: (M, J) centres of the bands.
        band_sd: (M, J) standard deviations of the bands.
        eta_inst: (M, J) written: instantaneous slowness of each output.
    """
    modules, _, outputs = y_frozen.shape
    known_by = NOVEL
    for m in range(modules):
        inside = True
        for j in range(outputs):
            eta_inst[m, j] = instantaneous_slowness(y_frozen[m, :, j])
            if not abs(eta_inst[m, j] - band_mean[m, j]) <= BAND * band_sd[m, j]:
                inside = False
        if inside and known_by == NOVEL:
            known_by = m + 1
    return known_by
