"""Policy iteration on the known transitions of stay and switch, in O(streams).

Stay leads from s to s; switch to each other stream with probability 1/(n-1). Under a policy
the values then obey V(s) = r_stay(s) / (1 - gamma) where it stays, and where it switches
V(s) = r_switch(s) + gamma (T - V(s)) / (n-1) with T the sum of all values: one unknown.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arithmetic.compiled import compiled

Float = NDArray[np.float64]
Int = NDArray[np.int64]

MAX_SWEEPS = 100
"""Policy iteration ends after a handful of sweeps; this only bounds rounding cycles."""

TIE = 1e-12
"""Share of an action value below which a difference is rounding, so that the tie goes to stay."""


LANES = 256
"""Sums side by side over many streams: one alone waits for each addition.

Their number is part of the result's rounding, so it is fixed and not left to the CPU.
"""


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
    horizon = (n - 1 + gamma) / (1.0 - gamma)
    leavers = 0
    total = 0.0
    whole = n - n % LANES
    if whole > 0:
        lanes = np.zeros(LANES)
        for first in range(0, whole, LANES):
            # Unsigned, so that numba leaves out the test for negative indices.
            for lane in range(np.uint64(LANES)):
                at = np.uint64(first) + lane
                kept = stay[at] * horizon
                left = switch[at]
                lanes[lane] += left if policy[at] == 1 else kept
                leavers += policy[at]
        for lane in range(LANES):
            total += lanes[lane]
    for s in range(whole, n):
        total += switch[s] if policy[s] == 1 else stay[s] * horizon
        leavers += policy[s]
    # Written so that nothing cancels when every stream is left and gamma is close to 1.
    return total / (n - leavers + (leavers - 1) * (1.0 - gamma))


@compiled
def improve(stay: Float, switch: Float, total: float, gamma: float, policy: Int) -> int:
    """Make a policy greedy for the values it has.

    With V(s) the value of s where it is left and where it stays, leaving is better under either
    policy where the first is greater.

    Args:
        stay: (S,) reward of staying.
        switch: (S,) reward of switching, summed over the n-1 streams it may lead to.
        total: sum T of the values under the policy.
        gamma: discount factor.
        policy: (S,) read and written: 0 stay, 1 switch.

    Returns:
        How many streams changed their mind.
    """
    n = len(stay)
    share, mean = gamma / (n - 1), 1.0 / (n - 1)
    arriving, damp, horizon = share * total, 1.0 / (1.0 + share), 1.0 / (1.0 - gamma)
    changed = 0
    for s in range(np.uint64(n)):
        keep = stay[s] * horizon
        leave = (switch[s] * mean + arriving) * damp
        better = np.int64(leave - keep > TIE * (abs(leave) + abs(keep)))
        changed += better ^ policy[s]
        policy[s] = better
    return changed


@compiled
def policy_iteration(stay_sum: Float, switch_sum: Float, gamma: float, policy: Int) -> None:
    """Improve a policy until it is optimal for R; ties go to stay.

    A common factor of R changes nothing, so the sums stand for it.

    Args:
        stay_sum: (S,) R's stay entries, times any number above 0.
        switch_sum: (S,) sum of R's switch entries from each stream, times the same.
        gamma: discount factor.
        policy: (S,) read and written: 0 stay, 1 switch.
    """
    if len(stay_sum) == 1:
        policy[0] = 0
        return
    for _ in range(MAX_SWEEPS):
        total = value_sum(stay_sum, switch_sum, policy, gamma)
        if improve(stay_sum, switch_sum, total, gamma, policy) == 0:
            return


@compiled
def action_values(
    stay_sum: Float, switch_sum: Float, count: float, gamma: float, policy: Int, Q: Float
) -> None:
    """Values of both actions in every stream, under a policy that needs none to be chosen.

    Args:
        stay_sum: (S,) R's stay entries times `count`.
        switch_sum: (S,) sum of R's switch entries from each stream, times `count`.
        count: common divisor of R; the number t of rewards in the sums, 0 before the first.
        gamma: discount factor.
        policy: (S,) 0 stay, 1 switch.
        Q: (S, 2) written.
    """
    n = len(stay_sum)
    if count <= 0.0:
        Q[:] = 0.0
        return
    if n == 1:
        Q[0] = stay_sum[0] / count / (1.0 - gamma)
        return
    share = gamma / (n - 1)
    arriving = share * value_sum(stay_sum, switch_sum, policy, gamma) / count
    damp, horizon = 1.0 / (1.0 + share), 1.0 / (1.0 - gamma)
    for s in range(n):
        reward = stay_sum[s] / count
        arrive = switch_sum[s] / count / (n - 1) + arriving
        value = arrive * damp if policy[s] == 1 else reward * horizon
        Q[s, 0] = reward + gamma * value
        Q[s, 1] = arrive - share * value
