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

TIE = 1e-12
"""Share of an action value below which a difference is rounding, so that the tie goes to stay."""


@compiled
def value_sum(stay: Float, switch: Float, policy: Int, gamma: float) -> float:
    """Sum T of the values of all streams under a policy.

    Args:
        stay: (S,) reward of staying.
        switch: (S,) reward of switching, summed over the n-1 streams it may lead to.
        policy: (S,) 0 stay, 1 switch.
        gamma: discount factor.
    """
    n = len(stay)
    staying = 0.0
    leaving = 0.0
    leavers = 0
    for s in range(n):
        leaves = policy[s]
        staying += stay[s] * (1 - leaves)
        leaving += switch[s] * leaves
        leavers += leaves
    fixed = staying / (1.0 - gamma) * (n - 1 + gamma) + leaving
    # Written so that nothing cancels when every stream is left and gamma is close to 1.
    return fixed / (n - leavers + (leavers - 1) * (1.0 - gamma))


@compiled
def improve(stay: Float, switch: Float, total: float, gamma: float, policy: Int) -> int:
    """Make a policy greedy for the values it has; return how many streams changed their mind.

    Args:
        stay: (S,) reward of staying.
        switch: (S,) reward of switching, summed over the n-1 streams it may lead to.
        total: sum T of the values under the policy.
        gamma: discount factor.
        policy: (S,) read and written: 0 stay, 1 switch.
    """
    n = len(stay)
    share, mean = gamma / (n - 1), 1.0 / (n - 1)
    damp, horizon = 1.0 / (1.0 + share), 1.0 / (1.0 - gamma)
    changed = 0
    for s in range(n):
        leave = (switch[s] * mean + share * total) * damp
        value = leave if policy[s] == 1 else stay[s] * horizon
        q_stay = stay[s] + gamma * value
        q_switch = switch[s] * mean + share * (total - value)
        better = 1 if q_switch - q_stay > TIE * (abs(q_stay) + abs(q_switch)) else 0
        changed += better ^ policy[s]
        policy[s] = better
    return changed


@compiled
def action_values(
    stay: Float, switch: Float, total: float, gamma: float, policy: Int, scale: float, Q: Float
) -> None:
    """Values of both actions in every stream under a policy, times `scale`.

    Args:
        stay: (S,) reward of staying.
        switch: (S,) reward of switching, summed over the n-1 streams it may lead to.
        total: sum T of the values under the policy.
        gamma: discount factor.
        policy: (S,) 0 stay, 1 switch.
        scale: common factor.
        Q: (S, 2) written.
    """
    n = len(stay)
    share, mean = gamma / (n - 1), 1.0 / (n - 1)
    damp, horizon = 1.0 / (1.0 + share), 1.0 / (1.0 - gamma)
    for s in range(n):
        leave = (switch[s] * mean + share * total) * damp
        value = leave if policy[s] == 1 else stay[s] * horizon
        Q[s, 0] = (stay[s] + gamma * value) * scale
        Q[s, 1] = (switch[s] * mean + share * (total - value)) * scale


@compiled
def policy_iteration(
    stay_sum: Float, switch_sum: Float, count: float, gamma: float, policy: Int, Q: Float
) -> None:
    """Improve a policy until it is optimal for R; ties go to stay.

    Args:
        stay_sum: (S,) R's stay entries times `count`.
        switch_sum: (S,) sum of R's switch entries from each stream, times `count`.
        count: common divisor of R; the number t of rewards in the sums.
        gamma: discount factor.
        policy: (S,) read and written: 0 stay, 1 switch.
        Q: (S, 2) written: action values under the policy.
    """
    if len(stay_sum) == 1:
        policy[0] = 0
        Q[0, 0] = stay_sum[0] / count / (1.0 - gamma)
        Q[0, 1] = Q[0, 0]
        return
    total = value_sum(stay_sum, switch_sum, policy, gamma)
    for _ in range(MAX_SWEEPS):
        if improve(stay_sum, switch_sum, total, gamma, policy) == 0:
            break
        total = value_sum(stay_sum, switch_sum, policy, gamma)
    action_values(stay_sum, switch_sum, total, gamma, policy, 1.0 / count, Q)
