"""Slowness of outputs on frames after those learned from, and batch SFA for comparison.

Frames are read piece by piece, so that the memory does not depend on their number.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cdmisfa import kernels
from cdmisfa.core.arrays import FloatArray
from cdmisfa.features.outputs import slowness_by_moments
from cdmisfa.features.recursive import STORED_PER_COMPONENT, RecursiveFeature

# Frames (n, I) in their order, and whether frames are missing before them.
Pieces = Iterable[tuple[NDArray[Any], bool]]

# Directions that are stored while frames are read, as a multiple of the components. Set by hand: a
# larger factor approaches exact batch SFA, and takes more time and memory.
BATCH_STORED_PER_COMPONENT = 8

# Share of the largest variance below which a direction holds rounding noise; as in `batch_sfa`.
TOLERANCE = 1e-10


class BatchOutputs(NamedTuple):
    """Outputs of batch SFA, fewer if the frames vary in fewer directions.

    Attributes:
        phi: (J, I) the slowest outputs as weights of the centred frame.
        mean: (I,) mean of the frames.
        directions: (K, I) the leading principal components, orthonormal, which span phi.
    """

    phi: FloatArray
    mean: FloatArray
    directions: FloatArray


def batch_outputs(pieces: Pieces, frames: int, components: int, outputs: int) -> BatchOutputs:
    """Return the slowest outputs within the leading principal components of frames.

    All frames have equal weights. The result is close to that of `batch_sfa` on the components, but
    not equal, because only `BATCH_STORED_PER_COMPONENT` directions a component are stored.

    Args:
        pieces: at least one piece of uint8 pixels, which count 1/255 each, or float64 values.
        frames: total number of frames.
        components: number of components K.
        outputs: number of outputs J.
    """
    # A RecursiveFeature stores STORED_PER_COMPONENT directions for each of its components.
    size = BATCH_STORED_PER_COMPONENT * components // STORED_PER_COMPONENT
    sfa: RecursiveFeature | None = None
    for x, gap in pieces:
        sfa = sfa or RecursiveFeature(x.shape[1], size, window=frames)
        sfa.update(x, gap)
    assert sfa is not None
    state = sfa.state
    variance = state.variance[: min(components, int(state.counts[0]))]
    variance = variance[variance > TOLERANCE * variance.max(initial=0.0)]
    size, scale = len(variance), 1 / np.sqrt(variance)
    _, rotation = np.linalg.eigh(state.differences[:size, :size] * scale * scale[:, None])
    directions = state.basis[:size]
    return BatchOutputs((rotation[:, :outputs].T * scale) @ directions, state.mean, directions)


class SlownessSums:
    """Sums from which the slowness of outputs over all frames follows, added piece by piece.

    Args:
        outputs: number of outputs J.
    """

    def __init__(self, outputs: int) -> None:
        self._count = self._steps = 0
        self._origin, self._total, self._squares, self._moved = np.zeros((4, outputs))
        self._last: FloatArray | None = None

    def add(self, y: FloatArray, gap: bool) -> None:
        """Add the outputs (n, J) on the next frames; `gap`: frames are missing before them."""
        if self._last is None:
            # So that a constant has no variance, and a large mean costs no digit.
            self._origin = y[0]
        before = y[:0] if gap or self._last is None else self._last[None]
        change, apart = np.diff(np.concatenate([before, y]), axis=0), y - self._origin
        self._count += len(y)
        self._steps += len(change)
        self._last = y[-1]
        self._total += apart.sum(axis=0)
        self._squares += (apart * apart).sum(axis=0)
        self._moved += (change * change).sum(axis=0)

    @property
    def slowness(self) -> FloatArray:
        """(J,) cycles a frame, infinite for a constant output, NaN if no frame follows another."""
        if not self._steps:
            return np.full(len(self._total), np.nan)
        variance = self._squares / self._count - (self._total / self._count) ** 2
        return slowness_by_moments(self._moved / self._steps, variance)


def following_slowness(
    pieces: Pieces, features: Sequence[tuple[FloatArray, FloatArray]]
) -> list[FloatArray]:
    """Return the slowness of the outputs of several features, in one pass over the frames.

    Args:
        pieces: see `batch_outputs`.
        features: weights phi (J, I) and mean (I,) of each, y = phi (x - mean).

    Returns:
        (J,) cycles a frame for each of them; infinite for a constant output, NaN if no frame
        follows another.
    """
    phi = np.concatenate([phi for phi, _ in features])
    offset = np.concatenate([kernels.mean_output(phi, mean) for phi, mean in features])
    sums = SlownessSums(len(phi))
    for x, gap in pieces:
        sums.add(kernels.outputs(phi, offset, x), gap)
    return np.split(sums.slowness, np.cumsum([len(phi) for phi, _ in features[:-1]]))
