"""How slow outputs are on frames that follow what was learned from, beside batch SFA's own.

Frames are taken block by block, so that memory holds few of them, however many there are.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cdmisfa import kernels
from cdmisfa.core.arrays import FloatArray
from cdmisfa.features.outputs import slowness_by_moments
from cdmisfa.features.recursive import RecursiveFeature

# Frames (n, I) in their order, and whether some are missing before them.
Pieces = Iterable[tuple[NDArray[Any], bool]]

# Directions that are kept while frames are taken in, for each that is wanted of all of them.
KEPT = 8

# Share of the largest variance below which a direction holds rounding noise.
NOTHING = 1e-10


class BatchOutputs(NamedTuple):
    """Outputs of batch SFA, fewer where the frames vary in fewer directions.

    Attributes:
        phi: (J, I) the slowest outputs as weights of the centred frame.
        mean: (I,) of the frames.
        directions: (K, I) the leading principal components, orthonormal, in which they are.
    """

    phi: FloatArray
    mean: FloatArray
    directions: FloatArray


def batch_outputs(pieces: Pieces, frames: int, components: int, outputs: int) -> BatchOutputs:
    """Return the slowest outputs of frames that all count the same, in their leading components.

    That is what `batch_sfa` finds of frames in memory within their leading principal components, up
    to how far the directions that are kept meanwhile, `KEPT` times as many, hold these.

    Args:
        pieces: at least one, uint8 pixels, which count 1/255 each, or float64 values.
        frames: how many there are in all.
        components: K.
        outputs: J.
    """
    sfa: RecursiveFeature | None = None
    for x, gap in pieces:
        sfa = sfa or RecursiveFeature(x.shape[1], KEPT * components // 2, window=frames)
        sfa.update(x, gap)
    assert sfa is not None
    state = sfa.state
    variance = state.variance[: min(components, int(state.counts[0]))]
    variance = variance[variance > NOTHING * variance.max(initial=0.0)]
    size, scale = len(variance), 1 / np.sqrt(variance)
    _, rotation = np.linalg.eigh(state.differences[:size, :size] * scale * scale[:, None])
    directions = state.basis[:size]
    return BatchOutputs((rotation[:, :outputs].T * scale) @ directions, state.mean, directions)


def following_slowness(
    pieces: Pieces, abstractions: Sequence[tuple[FloatArray, FloatArray]]
) -> list[FloatArray]:
    """`slowness` of the outputs of several abstractions, in one pass over frames.

    Args:
        pieces: see `batch_outputs`.
        abstractions: of each phi (J, I) and mean (I,), y = phi (x - mean).

    Returns:
        For each (J,) in 1/frame; infinite where an output stands still, and NaN where no frame
        follows another.
    """
    phi = np.concatenate([phi for phi, _ in abstractions])
    offset = np.concatenate([kernels.mean_output(*each) for each in abstractions])
    count, steps = 0, 0
    total, squares, moved = (np.zeros(len(phi)) for _ in range(3))
    last: FloatArray | None = None
    for x, gap in pieces:
        y = kernels.outputs(phi, offset, x)
        before = y[:0] if gap or last is None else last[None]
        change = np.diff(np.concatenate([before, y]), axis=0)
        count, steps, last = count + len(y), steps + len(change), y[-1]
        total += y.sum(axis=0)
        squares += (y * y).sum(axis=0)
        moved += (change * change).sum(axis=0)
    if not steps:
        return [np.full(len(phi), np.nan) for phi, _ in abstractions]
    variance = squares / count - (total / count) ** 2
    slow = [slowness_by_moments(*one) for one in zip(moved / steps, variance, strict=True)]
    return np.split(np.array(slow), np.cumsum([len(phi) for phi, _ in abstractions[:-1]]))
