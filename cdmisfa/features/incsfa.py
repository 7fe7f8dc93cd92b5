"""`IncrementalFeature`: incremental slow feature analysis (IncSFA), as in the paper's learner.

Sources: candid covariance-free incremental PCA (CCIPCA): Weng, Zhang and Hwang 2003; minor
component analysis (MCA) by sequential addition: Peng and Yi 2006; both combined as IncSFA:
Kompella, Luciw and Schmidhuber 2012. `kernels/incsfa.c` has the computation.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cdmisfa import kernels
from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.config import LearnerConfig

# Standard deviation of the initial CCIPCA vectors. Set by hand; it is small against the variance of
# the inputs, so that the first frames replace the initial vectors.
INITIAL_SD = 0.1


class IncSFAState(NamedTuple):
    """State of incremental SFA, as arrays that the kernels change in place.

    I inputs, K whitening components, J outputs.

    Attributes:
        mean: (I,) running mean of the input.
        v: (K, I) CCIPCA vectors; their lengths are the variances.
        d: (K,) lengths of `v`.
        gram: (K, K) inner products of `v`; stored for many inputs only.
        w: (J, K) MCA rows of length 1.
        z_prev: (K,) the previous frame, whitened.
        phi: (J, I) slow features as weights of the centred input, after the last frame
            that changed them.
        counts: (3,) number of frames; 1 if the last frame followed a gap, so that `phi` is older
            than `v`; number of frames since `gram` was computed from `v`.
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
    """Return a random initial state: CCIPCA vectors of `INITIAL_SD`, MCA rows of length 1.

    Args:
        rng: generator from which K*I, then J*K standard normal numbers are drawn.
        n_inputs: length I of an expanded frame.
        config: configuration with K = `components` and J = `outputs`.
    """
    K, J = config.components, config.outputs
    v, w = kernels.normal(rng, (K, n_inputs), (J, K))
    v *= INITIAL_SD
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
        state: the arrays of the state; write into them to restore another state.

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
        """State and constants as C takes them."""
        return kernels.incsfa(self.state, self._nu, self._window)

    def __getstate__(self) -> dict[str, Any]:
        """Return all attributes but `kernel`, which holds pointers."""
        return {name: value for name, value in vars(self).items() if name != "kernel"}

    def update(self, frames: NDArray[Any], gap: bool = False) -> FloatArray:
        """Learn from consecutive frames.

        Args:
            frames: (n, I) float64 values, or uint8 pixels, which count 1/255 each.
            gap: True if the first frame does not follow the last frame of the previous call.

        Returns:
            (n,) change xi of phi at each frame, NaN at the first frame after a gap.

        Raises:
            UsageError: the array does not have the shape (n, I) or the type of frames.
        """
        return kernels.incsfa_update(self.kernel, frames, gap)

    @property
    def phi(self) -> FloatArray:
        """(J, I) slow features as weights of the centred input."""
        return self.state.phi

    @property
    def mean(self) -> FloatArray:
        """(I,) running mean of the input."""
        return self.state.mean
