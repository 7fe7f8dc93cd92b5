"""When to save an abstraction: its output's statistics, and whether they have settled."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cdmisfa.agents.agent import Agent, Rules
from cdmisfa.agents.roc import cluster
from cdmisfa.core.arithmetic.compiled import compiled
from cdmisfa.features.slowness import (
    block_moments,
    block_variance,
    converged,
    slowness,
    window_rate,
)

Float = NDArray[np.float64]


@compiled
def recent_variance(agent: Agent, j: int) -> float:
    """Variance of output j over the slowness window."""
    return float(agent.recent_square[j] - agent.recent_mean[j] ** 2)


@compiled
def track_output(agent: Agent, rules: Rules, j: int, y: Float) -> None:
    """Take the block's output j into its slowness, its change, and the gate's statistics.

    Args:
        agent: memory to change; `novel_blocks` already counts this block.
        rules: windows.
        j: output.
        y: (n,) output j on the block.
    """
    n = len(y)
    blocks = agent.memory[0]["novel_blocks"]
    mean, square, derivative = block_moments(y)
    rate = min(1.0, max(2.0 * n / (rules.slowness_window + n), 1.0 / blocks))
    agent.derivative[j] += rate * (derivative - agent.derivative[j])
    agent.recent_mean[j] += rate * (mean - agent.recent_mean[j])
    agent.recent_square[j] += rate * (square - agent.recent_square[j])
    agent.y_sum[j] += mean * n
    agent.square_sum[j] += square * n
    frames = agent.y_frames[0] + n
    variance = agent.square_sum[j] / frames - (agent.y_sum[j] / frames) ** 2
    eta = slowness(agent.derivative[j], variance)
    change = abs(eta - agent.eta[j])
    if math.isnan(agent.eta_dot[j]):
        agent.eta_dot[j] = change
    else:
        agent.eta_dot[j] += 2.0 / (rules.eta_dot_window + 1.0) * (change - agent.eta_dot[j])
    agent.eta[j] = eta
    agent.eta_inst[j] = slowness(derivative, block_variance(y, mean))  # (4)
    if math.isinf(agent.eta_inst[j]):
        return  # an output that stands still has no slowness to average
    a = window_rate(rules.gate_window, blocks)
    step = agent.eta_inst[j] - agent.gate_mean[j]
    agent.gate_mean[j] += a * step
    agent.gate_variance[j] = (1.0 - a) * (agent.gate_variance[j] + a * step * step)


@compiled
def track_clusters(agent: Agent, rules: Rules, label: int, y: Float) -> float:
    """CD-MISFA 1.0: take the block's output into the clusters; its error, also in the mean."""
    m = agent.memory[0]
    error = cluster(agent.centres, agent.counts, label, y, rules.roc_radius, rules.roc_memory)
    if math.isnan(m["roc_error"]):
        m["roc_error"] = error
    else:
        m["roc_error"] += window_rate(rules.eta_dot_window, m["novel_blocks"]) * (
            error - m["roc_error"]
        )
    return error


@compiled
def ready_to_save(agent: Agent, rules: Rules) -> bool:
    """Whether the abstraction has converged on something alive, while the agent stays with it."""
    m = agent.memory[0]
    if m["novel_blocks"] <= rules.eta_dot_window or m["share"] < rules.novel_share:
        return False
    for j in range(len(agent.eta)):
        if recent_variance(agent, j) < rules.min_variance:
            return False
    if rules.tabular:
        return bool(m["roc_error"] < rules.roc_error)
    return converged(agent.eta_dot, rules.delta)
