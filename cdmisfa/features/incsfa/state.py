"""What an adaptive abstraction remembers, and the small equations both kernels share.

Sources: candid covariance-free incremental PCA (CCIPCA): Weng, Zhang and Hwang 2003;
minor component analysis (MCA) by sequential addition: Peng and Yi 2006; the two joined
as IncSFA: Kompella, Luciw and Schmidhuber 2012.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arithmetic.compiled import inlined
from cdmisfa.core.arithmetic.elementary import normal
from cdmisfa.core.config import LearnerConfig

Float = NDArray[np.float64]

RANK_TOLERANCE = 1e-10
"""Share of the largest whitening variance below which a component is rounding noise.

The Gram recursion knows the residual's energy to about 1e-15 of the frame's, so above
this share it is right to five digits or more; the strict kernel follows the same rule.
"""

LEAST_VARIANCE = 1e-30
"""Variance below which a component is rounding noise whatever the others are."""


class State(NamedTuple):
    """An adaptive abstraction: arrays only, changed in place by the kernels.

    I inputs, K whitening components, J outputs. Saving these arrays saves everything.

    Attributes:
        mean: (I,) running mean of the input.
        v: (K, I) CCIPCA vectors; their lengths are the variances.
        d: (K,) lengths of `v`.
        gram: (K, K) inner products of `v`; kept by the Gram kernel only.
        w: (J, K) MCA rows of length 1.
        z_prev: (K,) whitened previous frame.
        phi: (J, I) slow features as weights of the centred input, after the last frame
            that changed them.
        counts: (3,) int64: frames seen; 1 where the last frame followed a gap, so that
            `phi` is older than `v`; frames since `gram` was computed from `v`.
    """

    mean: Float
    v: Float
    d: Float
    gram: Float
    w: Float
    z_prev: Float
    phi: Float
    counts: NDArray[np.int64]


class Params(NamedTuple):
    """Constants of the learning rule.

    Attributes:
        nu: learning rate of MCA.
        mean_window: frames of the running mean.
    """

    nu: float
    mean_window: float


def parameters(config: LearnerConfig) -> Params:
    """Pick the kernels' share of a configuration, as floats: one compilation serves all."""
    return Params(float(config.nu), float(config.mean_window))


def new_state(rng: np.random.Generator, n_inputs: int, config: LearnerConfig) -> State:
    """Draw an abstraction: CCIPCA vectors .1 x standard normal, MCA rows normalised.

    Args:
        rng: where the K*I, then J*K normal numbers are drawn from.
        n_inputs: I, length of an expanded frame.
        config: gives K = `components` and J = `outputs`.
    """
    K, J = config.components, config.outputs
    v = 0.1 * normal(rng, (K, n_inputs))
    w = normal(rng, (J, K))
    w /= np.sqrt((w * w).sum(axis=1))[:, None]
    return State(
        mean=np.zeros(n_inputs),
        v=v,
        d=np.sqrt((v * v).sum(axis=1)),
        gram=np.zeros((K, K)),
        w=w,
        z_prev=np.zeros(K),
        phi=np.zeros((J, n_inputs)),
        counts=np.zeros(3, dtype=np.int64),
    )


@inlined
def mean_rate(n: int, window: float) -> float:
    """Rate of the running mean at the n-th frame (from 1): 1/n, then 2/(window + 1)."""
    return max(2.0 / (window + 1.0), 1.0 / n)


@inlined
def amnesic_weight(n: int) -> float:
    """Weight of the new frame in CCIPCA at the n-th frame (from 1); the old vector has the rest.

    Source: Weng et al. 2003, amnesic mean with constants 20, 200, 2000, 3; the counter
    is one ahead, because the initial vector counts as a frame.
    """
    k = n + 1.0
    if k < 20.0:
        amnesia = 0.0
    elif k < 200.0:
        amnesia = 3.0 * (k - 20.0) / 180.0
    else:
        amnesia = 3.0 + (k - 200.0) / 2000.0
    return (1.0 + amnesia) / k


@inlined
def rank_floor(d: Float) -> float:
    """Variance at or below which a component is rounding noise.

    Such a component is whitened to 0, contributes nothing to phi (see also `mca_step`) and
    does not shrink any further; it comes back as soon as the input varies along it.

    Args:
        d: (K,) lengths of the CCIPCA vectors.
    """
    largest = 0.0
    for j in range(d.shape[0]):
        largest = max(largest, d[j])
    return max(RANK_TOLERANCE * largest, LEAST_VARIANCE)


@inlined
def whitening_scale(d: float, floor: float) -> float:
    """Factor that turns u.v into a component of unit variance: d^-3/2, 0 for rounding noise."""
    return 1.0 / (d * np.sqrt(d)) if d > floor else 0.0


@inlined
def mca_step(w: Float, z_dot: Float, scale: Float, nu: float, step: Float) -> None:
    """Turn each row of w towards the next slowest direction, in place.

    Source: Peng and Yi 2006 with sequential addition, as in the authors' IncSFA:
    gamma = .24 / nu, rate nu / (1 + 1.2 j) for output j from 0. A component that is
    rounding noise would look perfectly slow: it counts as unchanged, and its share of a
    row is halved, so that rows turn to the components that live.

    Args:
        w: (J, K) rows of length 1.
        z_dot: (K,) change of the whitened frame; set to 0 for rounding noise.
        scale: (K,) whitening scales, 0 for rounding noise.
        nu: learning rate.
        step: (K,) scratch.
    """
    J, K = w.shape
    gamma = 0.24 / nu
    for k in range(K):
        if scale[k] == 0.0:
            z_dot[k] = 0.0
    for j in range(J):
        rate = nu / (1.0 + 1.2 * j)
        along = 0.0
        for k in range(K):
            along += z_dot[k] * w[j, k]
        for k in range(K):
            step[k] = z_dot[k] * along
        for p in range(j):
            overlap = 0.0
            for k in range(K):
                overlap += w[p, k] * w[j, k]
            overlap *= gamma
            for k in range(K):
                step[k] += overlap * w[p, k]
        length = 0.0
        for k in range(K):
            w[j, k] = (1.5 - rate) * w[j, k] - rate * step[k]
            if scale[k] == 0.0:
                w[j, k] *= 0.5
            length += w[j, k] * w[j, k]
        length = 1.0 / np.sqrt(length)
        for k in range(K):
            w[j, k] *= length
