"""The gate: is a block novel, known to a frozen module, or empty?"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cdmisfa.agents.roc import known_to
from cdmisfa.core.arithmetic.compiled import compiled
from cdmisfa.features.projection import outputs
from cdmisfa.features.slowness import instantaneous_slowness

Float = NDArray[np.float64]

CONSTANT_VARIANCE = 1e-12
"""A block in which no input varies more than this carries nothing to learn."""

ENOUGH = 4.0
"""2 suffices (see below); doubled against rounding."""

BAND = 2.0
"""Half width of a module's band of known slowness, in standard deviations (paper)."""

NOVEL = 0
"""Verdict: no frozen module knows the block. Positive verdicts are the module's index."""

CONSTANT = -1
"""Verdict: the block carries nothing to learn."""


class Frozen(NamedTuple):
    """All frozen modules in one stack, so that one pass over a block serves them all.

    Attributes:
        phi: (M J, I) weights.
        offset: (M J,) phi times the mean.
        band_mean: (M, J) centres of the bands of known slowness.
        band_sd: (M, J) their standard deviations.
        centres: (M, S, C, n, J) clusters; (M, 0, 0, 0, 0) but for CD-MISFA 1.0.
        counts: (M, S, C).
    """

    phi: Float
    offset: Float
    band_mean: Float
    band_sd: Float
    centres: Float
    counts: Float


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
                # Two values d apart have a variance of at least d^2 / 2n, whatever the others are.
                apart = (float(frames[k, i]) - float(frames[0, i])) * scale
                if apart * apart > ENOUGH * n * CONSTANT_VARIANCE:
                    return False
                suspect = True
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


@compiled
def recognise(
    frozen: Frozen,
    roc_error: float,
    stream: int,
    frames: NDArray[Any],
    x: NDArray[Any],
    scale: float,
    y_frozen: Float,
    eta_inst: Float,
    roc_error_frozen: Float,
) -> int:
    """The gate's verdict on a block: NOVEL, CONSTANT, or the module that knows it.

    Args:
        frozen: the frozen modules.
        roc_error: threshold of the clusters; used by CD-MISFA 1.0 only.
        stream: stream of the block.
        frames: (n, I) as they came.
        x: (n, I') expanded.
        scale: factor from a frame's values to the learner's.
        y_frozen: (M, n, J) written: outputs of the frozen modules.
        eta_inst: (M, J) written: their instantaneous slowness.
        roc_error_frozen: (M,) written: their clustering error; NaN but for CD-MISFA 1.0.
    """
    modules, n, J = y_frozen.shape
    if modules > 0:
        y = outputs(frozen.phi, frozen.offset, x)
        for m in range(modules):
            for t in range(n):
                for j in range(J):
                    y_frozen[m, t, j] = y[t, m * J + j]
    known_by = verdict(y_frozen, frozen.band_mean, frozen.band_sd, eta_inst)
    roc_error_frozen[:] = np.nan
    if frozen.counts.shape[1] > 0:
        known_by = known_to(
            frozen.centres, frozen.counts, stream, y_frozen, roc_error, roc_error_frozen
        )
    return CONSTANT if is_constant(frames, scale) else known_by
