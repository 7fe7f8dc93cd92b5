"""Policy iteration on the known transitions of stay and switch, in O(streams).

Stay leads from s to s; switch to each other stream with probability 1/(n-1). Under a policy
the values then obey V(s) = r_stay(s) / (1 - gamma) where it stays, and where it switches
V(s) = r_switch(s) + gamma (T - V(s)) / (n-1) with T the sum of all values: one unknown.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cdmisfa.compiled import compiled

Float = NDArray[np.float64]
Int = NDArray[np.int64]

MAX_SWEEPS = 100
"""Policy iteration ends after a handful of sweeps; this only bounds rounding cycles."""


@compiled
def value_sum(stay: Float, switch: Float, policy: Int, gamma: float) -> float:
    """Sum T of the values of all streams under a policy.

    Args:
        stay: (S,) expected reward of staying.
        switch: (S,) expected reward of switching.
        policy: (S,) 0 stay, 1 switch.
        gamma: discount factor.
    """
    n = len(stay)
    share = gamma / (n - 1)
    staying = 0.0
    leaving = 0.0
    leavers = 0
    for s in range(n):
        if policy[s] == 0:
            staying += stay[s]
        else:
            leaving += switch[s]
            leavers += 1
    fixed = staying / (1.0 - gamma) + leaving / (1.0 + share)
    return fixed / (1.0 - leavers * share / (1.0 + share))


@compiled
def policy_iteration(
    stay_sum: Float, switch_sum: Float, count: int, gamma: float, policy: Int, Q: Float
) -> None:
    """Improve a policy until it is optimal for R; ties go to stay.

    Args:
        stay_sum: (S,) sums of rewards for staying in each stream.
        switch_sum: (S,) sums of rewards for leaving each stream.
        count: number t of rewards in the sums; R is sum / t.
        gamma: discount factor.
        policy: (S,) read and written: 0 stay, 1 switch.
        Q: (S, 2) written: action values under the policy.
    """
    n = len(stay_sum)
    if n == 1:
        policy[0] = 0
        Q[0, 0] = stay_sum[0] / count / (1.0 - gamma)
        Q[0, 1] = Q[0, 0]
        return
    share = gamma / (n - 1)
    switch = switch_sum / (n - 1)
    for _ in range(MAX_SWEEPS):
        total = value_sum(stay_sum, switch, policy, gamma)
        changed = 0
        for s in range(n):
            leave = (switch[s] + share * total) / (1.0 + share)
            value = leave if policy[s] == 1 else stay_sum[s] / (1.0 - gamma)
            q_stay = stay_sum[s] + gamma * value
            q_switch = switch[s] + share * (total - value)
            Q[s, 0] = q_stay / count
            Q[s, 1] = q_switch / count
            better = 1 if q_switch > q_stay else 0
            changed += better != policy[s]
            policy[s] = better
        if changed == 0:
            return
