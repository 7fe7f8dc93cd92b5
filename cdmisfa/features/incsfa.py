"""`IncrementalFeature`: the adaptive abstraction of the paper's learner.

Sources: candid covariance-free incremental PCA (CCIPCA): Weng, Zhang and Hwang 2003;
minor component analysis (MCA) by sequential addition: Peng and Yi 2006; the two joined
as IncSFA: Kompella, Luciw and Schmidhuber 2012. How it is computed: `kernels/incsfa.c`.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cdmisfa import kernels
from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.config import LearnerConfig


class IncSFAState(NamedTuple):
    """An adaptive abstraction: arrays only, changed in place by the kernels.

    I inputs, K whitening components, J outputs. Saving these arrays saves everything.

    Attributes:
        mean: (I,) running mean of the input.
        v: (K, I) CCIPCA vectors; their lengths are the variances.
        d: (K,) lengths of `v`.
        gram: (K, K) inner products of `v`; kept for many inputs only.
        w: (J, K) MCA rows of length 1.
        z_prev: (K,) whitened previous frame.
        phi: (J, I) slow features as weights of the centred input, after the last frame
            that changed them.
        counts: (3,) int64: frames seen; 1 where the last frame followed a gap, so that
            `phi` is older than `v`; frames since `gram` was computed from `v`.
    """

    mean: FloatArray
    v: FloatArray
    d: FloatArray
    gram: FloatArray
    w: FloatArray
    z_prev: FloatArray
    phi: FloatArray
    counts: NDArray[np.int64]


def new_state(rng: np.random.Generator, n_inputs: int, config: LearnerConfig) -> IncSFAState:
    """Draw an abstraction: CCIPCA vectors .1 x standard normal, MCA rows normalised.

    Args:
        rng: where the K*I, then J*K normal numbers are drawn from.
        n_inputs: I, length of an expanded frame.
        config: gives K = `components` and J = `outputs`.
    """
    K, J = config.components, config.outputs
    v, w = kernels.normal(rng, (K, n_inputs), (J, K))
    v *= 0.1
    w /= np.sqrt((w * w).sum(axis=1))[:, None]
    return IncSFAState(
        mean=np.zeros(n_inputs),
        v=v,
        d=np.sqrt((v * v).sum(axis=1)),
        gram=np.zeros((K, K)),
        w=w,
        z_prev=np.zeros(K),
        phi=np.zeros((J, n_inputs)),
        counts=np.zeros(3, dtype=np.int64),
    )


class IncrementalFeature:
    """Incremental slow feature analysis, frame by frame: y = phi (x - mean).

    Attributes:
        state: every array of it; write into them to restore another state.

    Example:
        >>> sfa = IncrementalFeature(LearnerConfig(), 5, np.random.default_rng(0))
        >>> sfa.update(np.random.default_rng(1).random((100, 5))).shape
        (100,)
    """

    def __init__(self, config: LearnerConfig, n_inputs: int, rng: np.random.Generator) -> None:
        self.state = new_state(rng, n_inputs, config)
        self._nu, self._window = config.nu, config.mean_window

    @cached_property
    def kernel(self) -> kernels.Struct:
        """The state with the constants of the rule, as the kernels take it."""
        return kernels.incsfa(self.state, self._nu, self._window)

    def __getstate__(self) -> dict[str, Any]:
        """Without `kernel`, whose pointers are of this process."""
        return {name: value for name, value in vars(self).items() if name != "kernel"}

    def update(self, frames: NDArray[Any], gap: bool = False) -> FloatArray:
        """Learn from consecutive frames.

        Args:
            frames: (n, I) float64 values, or uint8 pixels, which count 1/255 each.
            gap: the first frame does not follow the last one learned from.

        Returns:
            xi, (n,): change of phi at each frame, NaN at the first after a gap.

        Raises:
            UsageError: these are no frames of I values.
        """
        return kernels.incsfa_update(self.kernel, frames, gap)

    @property
    def phi(self) -> FloatArray:
        """Slow features as weights of the centred input, (J, I)."""
        return self.state.phi

    @property
    def mean(self) -> FloatArray:
        """Running mean of the input, (I,)."""
        return self.state.mean
