"""`RecursiveFeature`: slow feature analysis of all frames so far, without a learning rate.

It stores the largest principal components of the frames and the covariance of the differences of
consecutive frames along these components, both over an exponential window. The slow features are
the directions of smallest derivative among the whitened components: a small eigenvalue problem that
is solved for every block. Outputs have variance 1, whatever the units of the frames.

`cdmisfa/kernels/recursive.c` has the computation and its sources.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cdmisfa import kernels
from cdmisfa.core.arrays import FloatArray, IntArray
from cdmisfa.core.errors import UsageError

# Frames that one update of the basis takes; longer blocks are cut into pieces of this length.
PIECE: int = kernels.lib.PIECE

# Directions that are stored for each whitened component. Set by hand (decision 0021): directions
# beyond the whitened ones let a component grow that is small at first. Memory and time of an
# update grow with it.
STORED_PER_COMPONENT = 2

# Smallest variance to divide by, so that a constant output has finite slowness.
_MIN_VARIANCE = 1e-300


class RecursiveState(NamedTuple):
    """State of a `RecursiveFeature`: I inputs, L directions, K whitened components, J outputs.

    Attributes:
        mean: (I,) mean of the frames.
        basis: (L, I) orthonormal directions, in order of falling variance.
        variance: (L,) variance of the frames along each direction.
        differences: (L, L) mean products of the differences of consecutive frames along the
            directions.
        weights: (J, L) the outputs as weights of the directions, the slow ones first.
        spectrum: (K,) slowness of all slow features of the leading K components, the slowest
            first; NaN for a feature that does not exist.
        last: (I,) the last frame.
        counts: (3,) number of directions in use, of frames in `mean` and `variance`, and of
            differences in `differences`. The latter two stop at the window.
    """

    mean: FloatArray
    basis: FloatArray
    variance: FloatArray
    differences: FloatArray
    weights: FloatArray
    spectrum: FloatArray
    last: FloatArray
    counts: IntArray


class Agreement(NamedTuple):
    """Comparison of an output with the slowest feature of a stream.

    Attributes:
        variance: variance of the output on the stream.
        slowness: slowness of the output on the stream (cycles a frame).
        rho: absolute correlation of the output with the slowest feature, 0 to 1.
    """

    variance: float
    slowness: float
    rho: float


class RecursiveFeature:
    """Slow feature analysis of all frames so far, updated block by block.

    The outputs are the slowest feature of the leading K components, then the other slow features,
    then principal components with variance 1. After `widen` the other slow features come from more
    components and are uncorrelated with the first.

    If the frames vary in at most 2 K directions, no direction is dropped and the result does not
    depend on how the frames are cut into calls, up to rounding.

    Args:
        n_inputs: number of values I of a frame.
        components: number of whitened principal components K; 2 K are stored.
        outputs: number of slow features.
        window: exponential window (frames); the first `window` frames have equal weights.
        principal: number of principal components among the outputs, at most K.
        wide: number of components after `widen`; as many directions are stored, or 2 K.

    Attributes:
        state: the arrays of the state; write into them to restore another state.
        is_wide: whether the outputs are found among `wide` components.

    Example:
        >>> t = np.arange(2000.0)
        >>> sfa = RecursiveFeature(2, components=2)
        >>> change = sfa.update(np.stack([np.sin(t / 50) + np.sin(t), np.sin(t)], axis=1))
        >>> round(float(sfa.slowness * 2 * np.pi * 50), 2)
        0.99
    """

    def __init__(
        self,
        n_inputs: int,
        components: int,
        outputs: int = 1,
        window: int = 8000,
        *,
        principal: int = 0,
        wide: int = 0,
    ) -> None:
        if min(n_inputs, outputs, window) < 1 or outputs > components or principal < 0:
            raise UsageError(
                f"no SFA has {n_inputs} inputs, {components} components, {outputs} outputs, "
                f"{principal} principal outputs and a window of {window}: set all but "
                "the principal outputs to at least 1, and outputs to at most components"
            )
        size = min(STORED_PER_COMPONENT * components, n_inputs)
        components = min(components, n_inputs)
        self.window, self.is_wide = window, False
        self._principal, self._wide = min(principal, components), min(wide, n_inputs)
        self.state = RecursiveState(
            mean=np.zeros(n_inputs),
            basis=np.zeros((size, n_inputs)),
            variance=np.zeros(size),
            differences=np.zeros((size, size)),
            weights=np.zeros((min(outputs, components) + self._principal, size)),
            spectrum=np.full(components, np.nan),
            last=np.zeros(n_inputs),
            counts=np.zeros(3, np.int64),
        )

    def widen(self) -> None:
        """Find the outputs among `wide` components from now on, if these are more than K."""
        state = self.state
        if self.is_wide or self._wide <= len(state.spectrum):
            return
        self.is_wide, rows = True, (0, max(self._wide - len(state.variance), 0))
        self.state = state._replace(
            basis=np.pad(state.basis, (rows, (0, 0))),
            variance=np.pad(state.variance, rows),
            differences=np.pad(state.differences, rows),
            weights=np.pad(state.weights, ((0, 0), rows)),
        )
        self.__dict__.pop("_record", None)

    def update(self, frames: NDArray[Any], gap: bool = False) -> FloatArray:
        """Learn from consecutive frames.

        Equation: P1

        Args:
            frames: (n, I) uint8 pixels, which count 1/255 each, or float64 values.
            gap: True if the first frame does not follow the last frame of the previous call.

        Returns:
            (n,) at the last frame of each piece the change of the slowest output, NaN elsewhere
            and in the first piece. The change is sqrt(2 - 2 |rho|), 0 to sqrt(2), where rho is the
            correlation of the output before and after the piece.

        Raises:
            UsageError: the array does not have the shape (n, I) or the type of frames.
        """
        return kernels.recursive_update(self._record, frames, gap)

    @cached_property
    def _record(self) -> kernels.Struct:
        wide = self._wide if self.is_wide else 0
        return kernels.recursive_state(self.state._asdict(), self.window, wide, self._principal)

    def __getstate__(self) -> dict[str, Any]:
        """Return all attributes but the C record, which holds pointers."""
        return {name: value for name, value in vars(self).items() if name != "_record"}

    @property
    def slowness(self) -> float:
        """Slowness of the slowest output on the frames learned from; NaN before the first."""
        return float(self.state.spectrum[0])

    @property
    def output_slowness(self) -> FloatArray:
        """(J,) slowness of each output on the frames learned from; NaN before the first."""
        weights, variance = self.state.weights, self.state.variance
        steps = (kernels.multiply(weights, self.state.differences) * weights).sum(axis=1)
        with np.errstate(invalid="ignore"):
            squares = steps / (weights * weights * variance).sum(axis=1)
            return np.asarray(np.sqrt(np.maximum(squares, 0.0)) / (2.0 * math.pi))

    @property
    def phi(self) -> FloatArray:
        """(J, I) outputs as weights of the centred frame."""
        rank = self.state.counts[0]
        return kernels.multiply(self.state.weights[:, :rank], self.state.basis[:rank])

    @property
    def mean(self) -> FloatArray:
        """(I,) mean of the frames."""
        return self.state.mean

    def compare(self, phi: FloatArray, frames: NDArray[Any] | None = None) -> Agreement:
        """Compare another output with the slowest feature, on the frames learned from.

        The frames themselves are not stored: variance and slowness follow from the stored
        directions, plus an estimate of what the output takes from outside them.

        Args:
            phi: (I,) weights of the output for the centred frame.
            frames: (n, I) the last frames learned from, for the estimate; None: assume that the
                output takes nothing from outside the stored directions.
        """
        rank = self.state.counts[0]
        basis, variance = self.state.basis[:rank], self.state.variance[:rank]
        q = kernels.outputs(basis, np.zeros(len(basis)), phi[None])
        power = kernels.multiply(q * variance, q.T).item()
        moved = kernels.multiply(q, self.state.differences[:rank, :rank])
        steps = kernels.multiply(moved, q.T).item()
        if frames is not None:
            outside = phi - kernels.multiply(q, basis)
            rest = kernels.outputs(outside, kernels.mean_output(outside, self.mean), frames)
            power += kernels.multiply(rest.T, rest).item() / len(rest)
            jumps = np.diff(rest, axis=0)
            steps += kernels.multiply(jumps.T, jumps).item() / max(len(jumps), 1)
        shared = kernels.multiply(q * variance, self.state.weights[:1, :rank].T).item()
        return Agreement(
            variance=power,
            slowness=math.sqrt(max(steps, 0.0) / max(power, _MIN_VARIANCE)) / (2.0 * math.pi),
            rho=min(abs(shared) / math.sqrt(max(power, _MIN_VARIANCE)), 1.0),
        )
