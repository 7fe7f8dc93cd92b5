"""`RecursiveFeature`: the slowest outputs of all frames so far, exactly, without a learning rate.

Kept are the largest principal components of the frames and the covariance of the differences
of consecutive frames along them, each over an exponential window. The slow features are the
directions of least derivative among the whitened components: a small eigenvalue problem, solved
again for every block. Outputs have unit variance, whatever the units of the frames.

It is computed, and its sources are named, in `cdmisfa/kernels/recursive.c`.
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

# Frames taken in at once; longer blocks are cut into pieces of so many.
PIECE: int = kernels.lib.PIECE

_TINY = 1e-300


class RecursiveState(NamedTuple):
    """Everything that changes: I inputs, L directions, K whitened components, J outputs.

    Attributes:
        mean: (I,) mean of the frames.
        basis: (L, I) orthonormal directions, those of the largest variance first.
        variance: (L,) along them.
        differences: (L, L) mean square of the differences of consecutive frames along them.
        weights: (J, L) the slow features as weights of the directions.
        spectrum: (K,) slowness of all slow features, the slowest first; NaN where there is none.
        last: (I,) the last frame.
        counts: (3,) directions in use; frames in `mean` and `variance`; differences in
            `differences`. The latter two stop at the window.
    """

    mean: FloatArray
    basis: FloatArray
    variance: FloatArray
    differences: FloatArray
    weights: FloatArray
    spectrum: FloatArray
    last: FloatArray
    counts: IntArray


class Likeness(NamedTuple):
    """Agreement of an output with the slowest feature of a stream.

    Attributes:
        variance: of that output.
        slowness: of it.
        rho: its correlation with the slowest feature, from 0 to 1.
    """

    variance: float
    slowness: float
    rho: float


class RecursiveFeature:
    """Slow feature analysis of all frames so far, in blocks.

    Where the frames have no more directions than are kept (twice `components`), nothing is
    left out and it does not matter how they are cut into calls, but for rounding.

    Args:
        n_inputs: I, values of a frame.
        components: K, principal components that are whitened; twice as many are kept.
        outputs: J.
        window: frames of the exponential window; the first so many all count the same.

    Attributes:
        state: every array of it; write into them to restore another state.

    Example:
        >>> t = np.arange(2000.0)
        >>> sfa = RecursiveFeature(2, components=2)
        >>> change = sfa.update(np.stack([np.sin(t / 50) + np.sin(t), np.sin(t)], axis=1))
        >>> round(float(sfa.slowness * 2 * np.pi * 50), 2)
        0.99
    """

    def __init__(
        self, n_inputs: int, components: int, outputs: int = 1, window: int = 8000
    ) -> None:
        if n_inputs < 1 or not 1 <= outputs <= components or window < 1:
            raise UsageError(
                f"no SFA of {n_inputs} inputs, {components} components, {outputs} outputs and a "
                f"window of {window}: each is at least 1, and outputs at most components"
            )
        size = min(2 * components, n_inputs)
        components = min(components, n_inputs)
        self.window = window
        self.state = RecursiveState(
            mean=np.zeros(n_inputs),
            basis=np.zeros((size, n_inputs)),
            variance=np.zeros(size),
            differences=np.zeros((size, size)),
            weights=np.zeros((min(outputs, components), size)),
            spectrum=np.full(components, np.nan),
            last=np.zeros(n_inputs),
            counts=np.zeros(3, np.int64),
        )

    def update(self, frames: NDArray[Any], gap: bool = False) -> FloatArray:
        """Learn from consecutive frames.

        Equation: P1

        Args:
            frames: (n, I) uint8 pixels, which count 1/255 each, or float64 values.
            gap: the first frame does not follow the last one learned from.

        Returns:
            (n,): at the last frame of each piece, the change of the slowest output:
            sqrt(2 - 2 |rho|) of its correlation rho with the one before, from 0 to sqrt 2; NaN
            elsewhere, and where there was none before.

        Raises:
            UsageError: these are no frames of I values.
        """
        return kernels.recursive_update(self._record, frames, gap)

    @cached_property
    def _record(self) -> kernels.Struct:
        return kernels.recursive_state(self.state._asdict(), self.window)

    def __getstate__(self) -> dict[str, Any]:
        """All but the record, which points to its own arrays."""
        return {name: value for name, value in vars(self).items() if name != "_record"}

    @property
    def slowness(self) -> float:
        """Slowness of the slowest output on the frames it learned from, NaN without any."""
        return float(self.state.spectrum[0])

    @property
    def phi(self) -> FloatArray:
        """Slow features as weights of the centred input, (J, I)."""
        rank = self.state.counts[0]
        return kernels.multiply(self.state.weights[:, :rank], self.state.basis[:rank])

    @property
    def mean(self) -> FloatArray:
        """Mean of the input, (I,)."""
        return self.state.mean

    def compare(self, phi: FloatArray, frames: NDArray[Any] | None = None) -> Likeness:
        """Return what another output gives on what was learned from, which is not kept.

        Args:
            phi: (I,) its weights of the centred input.
            frames: (n, I) the last that were learned from, which tell what it takes from outside
                of the directions kept; without them that counts as nothing.
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
        return Likeness(
            variance=power,
            slowness=math.sqrt(max(steps, 0.0) / max(power, _TINY)) / (2.0 * math.pi),
            rho=min(abs(shared) / math.sqrt(max(power, _TINY)), 1.0),
        )
