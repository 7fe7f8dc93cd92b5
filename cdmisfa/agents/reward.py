"""Rewards: curiosity, expertise, and the running reward function of CD-MISFA 2.0."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arithmetic.compiled import compiled
from cdmisfa.core.arithmetic.elementary import exp

Float = NDArray[np.float64]


@compiled
def expert_reward(xi: float, sigma: float, beta: float) -> float:
    """Beta times the Gaussian Z of the mean weight change; sigma 0 means none.

    Equation: 5
    """
    if sigma <= 0.0:
        return 0.0
    return beta * exp(-xi * xi / (2.0 * sigma * sigma))


@compiled
def curiosity_reward(xi: float, xi_previous: float) -> float:
    """How much the mean weight change fell since the novel block before.

    Equation: 5
    """
    return -(xi - xi_previous)


@compiled
def add_reward(
    stay: Float, switch: Float, dense: Float, s: int, a: int, s_next: int, r: float
) -> None:
    """Take one reward into the sums whose quotient by their count t is R.

    R <- R~/t + (1 - 1/t) R, with R~ zero but for the entry (s, a, s'), is the mean over all
    rewarded iterations: sum / t. Kept are the sums that the policy needs, and the tensor where
    it is small.

    Args:
        stay: (S,) sums of the rewards for staying in s.
        switch: (S,) sums of the rewards for leaving s, wherever it led.
        dense: (S, 2, S) sums of every entry, or (0, 2, 0).
        s: stream before the action.
        a: 0 stay, 1 switch.
        s_next: stream after the action.
        r: reward.

    Equation: 6
    """
    if a == 0:
        stay[s] += r
    else:
        switch[s] += r
    if dense.shape[0] > 0:
        dense[s, a, s_next] += r


@compiled
def add_reward_locally(
    stay: Float, switch: Float, dense: Float, s: int, a: int, s_next: int, r: float, alpha: float
) -> float:
    """CD-MISFA 1.0: move the entry (s, a, s') towards the reward; return the tensor's norm.

    R~(s,a,s') <- alpha r + (1 - alpha) R~(s,a,s'), R = R~ / |R~|. No other entry changes, which
    is what makes 1.0 unstable.

    Source: paper, CD-MISFA 1.0 vs CD-MISFA 2.0 (b).

    Args:
        stay: (S,) written: R~(s, stay, s).
        switch: (S,) written: sum of R~(s, switch, s') over s'.
        dense: (S, 2, S) R~, in place.
        s: stream before the action.
        a: 0 stay, 1 switch.
        s_next: stream after the action.
        r: reward.
        alpha: learning rate.
    """
    dense[s, a, s_next] += alpha * (r - dense[s, a, s_next])
    stay[s] = dense[s, 0, s]
    switch[s] = 0.0
    for following in range(len(switch)):
        switch[s] += dense[s, 1, following]
    square = 0.0
    for before in range(len(stay)):
        for action in range(2):
            for following in range(len(stay)):
                square += dense[before, action, following] ** 2
    return math.sqrt(square)
