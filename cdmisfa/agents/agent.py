"""The curiosity-driven agent: its memory, and one iteration of its thinking.

Everything here is compiled and works on arrays, so that `CuriousLearner.step` and the
compiled whole-trial loop run the very same code. An iteration costs O(streams).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cdmisfa.agents.exploration import choose, decay, other_stream
from cdmisfa.agents.gate import NOVEL
from cdmisfa.agents.policy import policy_iteration
from cdmisfa.agents.reward import add_reward, add_reward_locally, curiosity_reward, expert_reward
from cdmisfa.agents.roc import cluster
from cdmisfa.core.compiled import compiled
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.errors import UsageError
from cdmisfa.core.signals import DENSE_STREAMS
from cdmisfa.features.slowness import (
    block_moments,
    converged,
    instantaneous_slowness,
    slowness,
    window_rate,
)

Float = NDArray[np.float64]
Int = NDArray[np.int64]

MEMORY = np.dtype(
    [
        ("iteration", "i8"),  # iterations so far
        ("module", "i8"),  # abstraction being learned, from 1
        ("stream", "i8"),  # stream to watch next
        ("last_stream", "i8"),  # stream before the last action; -1 before the first
        ("last_action", "i8"),
        ("fed_stream", "i8"),  # stream of the last novel block; -1 none
        ("fed_until", "i8"),  # frame after the last novel block
        ("novel_blocks", "i8"),  # since the abstraction was created
        ("rewards", "i8"),  # t of the running reward function
        ("scale", "f8"),  # what the sums are divided by to give R; 0 before the first reward
        ("roc_error", "f8"),  # CD-MISFA 1.0: running mean of the clustering error
        ("xi", "f8"),  # mean weight change of the last novel block
        ("share", "f8"),  # running share of novel blocks
        ("epsilon", "f8"),
        ("idle", "i8"),  # iterations with epsilon practically 0
    ]
)

OUTCOME = np.dtype(
    [
        ("stream", "i8"),
        ("module", "i8"),
        ("novel", "?"),
        ("known_by", "i8"),
        ("saved", "?"),
        ("share", "f8"),
        ("novel_blocks", "i8"),
        ("roc_error", "f8"),
        ("roc_error_inst", "f8"),
        ("xi", "f8"),
        ("xi_dot", "f8"),
        ("curiosity", "f8"),
        ("expert", "f8"),
        ("reward", "f8"),
        ("epsilon", "f8"),
        ("explored", "?"),
        ("action", "i8"),
        ("next_stream", "i8"),
    ]
)

IDLE_EPSILON = 1e-3
"""Below this the agent practically no longer explores."""


class Agent(NamedTuple):
    """The agent's memory, as arrays only (so it can be saved and compiled).

    memory: (1,) of `MEMORY`. Per output (J,): eta, eta_dot, eta_inst, gate_mean, gate_variance,
    the running E(ydot^2) derivative, the sums y_sum and square_sum over y_frames (1,) frames, and
    the recent moments recent_mean, recent_square. Per stream: stay_sum, switch_sum, policy (S,),
    dense (S, 2, S) or (0, 2, 0). CD-MISFA 1.0 only, else empty: the clustering's
    centres (S, C, tau, J) and counts (S, C).
    """

    memory: NDArray[np.void]
    eta: Float
    eta_dot: Float
    eta_inst: Float
    gate_mean: Float
    gate_variance: Float
    derivative: Float
    y_sum: Float
    square_sum: Float
    y_frames: Int
    recent_mean: Float
    recent_square: Float
    stay_sum: Float
    switch_sum: Float
    dense: Float
    policy: Int
    centres: Float
    counts: Float


class Rules(NamedTuple):
    """The numbers of `LearnerConfig` that one iteration needs."""

    sigma: float
    beta: float
    delta: float
    gamma: float
    epsilon_start: float
    epsilon_decay: float
    epsilon_knee: float
    epsilon_tail_decay: float
    slowness_window: float
    eta_dot_window: float
    gate_window: float
    warm_up: float
    min_variance: float
    novel_share: float
    tabular: bool
    alpha: float
    roc_radius: float
    roc_memory: float
    roc_error: float


def rules(config: LearnerConfig, n_streams: int) -> Rules:
    """The rules of a configuration for n streams."""
    special: Any = {"beta": config.reward_beta(n_streams), "tabular": config.algorithm == "1.0"}
    values: Any = {n: float(getattr(config, n)) for n in Rules._fields if n not in special}
    return Rules(**special, **values)


def new_agent(config: LearnerConfig, n_streams: int, first_stream: int) -> Agent:
    """An agent that has seen nothing and will watch `first_stream`.

    Raises:
        UsageError: more streams than CD-MISFA 1.0's table of rewards is kept for.
    """
    outputs = config.outputs
    dense = n_streams if n_streams <= DENSE_STREAMS else 0
    clusters = (n_streams, config.roc_centres) if config.algorithm == "1.0" else (0, 0)
    if config.algorithm == "1.0" and not dense:
        raise UsageError(
            f"learner.algorithm 1.0 takes at most {DENSE_STREAMS} streams, not {n_streams}"
        )
    memory = np.zeros(1, MEMORY)
    agent = Agent(
        memory=memory,
        eta=np.zeros(outputs),
        eta_dot=np.zeros(outputs),
        eta_inst=np.zeros(outputs),
        gate_mean=np.zeros(outputs),
        gate_variance=np.zeros(outputs),
        derivative=np.zeros(outputs),
        y_sum=np.zeros(outputs),
        square_sum=np.zeros(outputs),
        y_frames=np.zeros(1, np.int64),
        recent_mean=np.zeros(outputs),
        recent_square=np.zeros(outputs),
        stay_sum=np.zeros(n_streams),
        switch_sum=np.zeros(n_streams),
        dense=np.zeros((dense, 2, dense)),
        policy=np.zeros(n_streams, np.int64),
        centres=np.zeros((*clusters, config.tau, outputs)),
        counts=np.zeros(clusters),
    )
    memory["last_stream"] = -1
    memory["stream"] = first_stream
    begin_abstraction(agent, config.epsilon_start)
    return agent


@compiled
def begin_abstraction(agent: Agent, epsilon_start: float) -> None:
    """Forget everything that belongs to the abstraction before; all statistics start anew."""
    m = agent.memory[0]
    m["module"] += 1
    m["fed_stream"] = -1
    m["fed_until"] = -1
    m["novel_blocks"] = 0
    m["rewards"] = 0
    m["scale"] = 0.0
    m["roc_error"] = math.nan
    m["xi"] = math.nan
    m["share"] = 1.0
    m["epsilon"] = epsilon_start
    m["idle"] = 0
    agent.eta[:] = math.nan
    agent.eta_dot[:] = math.nan
    agent.eta_inst[:] = math.nan
    agent.gate_mean[:] = 0.0
    agent.gate_variance[:] = 0.0
    agent.derivative[:] = 0.0
    agent.y_sum[:] = 0.0
    agent.square_sum[:] = 0.0
    agent.y_frames[:] = 0
    agent.recent_mean[:] = 0.0
    agent.recent_square[:] = 0.0
    agent.stay_sum[:] = 0.0
    agent.switch_sum[:] = 0.0
    agent.dense[:] = 0.0
    agent.policy[:] = 0
    agent.centres[:] = 0.0
    agent.counts[:] = 0.0


@compiled
def has_gap(agent: Agent, stream: int, t: int) -> bool:
    """Whether a novel block does not continue the last novel one frame by frame."""
    m = agent.memory[0]
    return bool(m["fed_stream"] != stream or m["fed_until"] != t)


@compiled
def mean_change(xi: Float) -> float:
    """Mean weight change over the frames of a block that have one (not the first after a gap)."""
    total = 0.0
    count = 0
    for value in xi:
        if not math.isnan(value):
            total += value
            count += 1
    return total / count if count > 0 else math.nan


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
    agent.eta_inst[j] = instantaneous_slowness(y)
    if math.isinf(agent.eta_inst[j]):
        return  # an output that stands still has no slowness to average
    a = window_rate(rules.gate_window, blocks)
    step = agent.eta_inst[j] - agent.gate_mean[j]
    agent.gate_mean[j] += a * step
    agent.gate_variance[j] = (1.0 - a) * (agent.gate_variance[j] + a * step * step)


@compiled
def ready_to_save(agent: Agent, rules: Rules) -> bool:
    """Whether the abstraction has converged on something alive that it is really fed with."""
    m = agent.memory[0]
    if m["novel_blocks"] <= rules.eta_dot_window or m["share"] < rules.novel_share:
        return False
    for j in range(len(agent.eta)):
        if recent_variance(agent, j) < rules.min_variance:
            return False
    if rules.tabular:
        return bool(m["roc_error"] < rules.roc_error)
    return converged(agent.eta_dot, rules.delta)


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
def estimate_reward(agent: Agent, rules: Rules, stream: int, reward: float) -> None:
    """Take the reward of the last transition into R and improve the policy."""
    m = agent.memory[0]
    m["rewards"] += 1
    if rules.tabular:
        m["scale"] = add_reward_locally(
            agent.stay_sum,
            agent.switch_sum,
            agent.dense,
            m["last_stream"],
            m["last_action"],
            stream,
            reward,
            rules.alpha,
        )
    else:
        add_reward(
            agent.stay_sum,
            agent.switch_sum,
            agent.dense,
            m["last_stream"],
            m["last_action"],
            stream,
            reward,
        )
        m["scale"] = m["rewards"]
    if m["scale"] > 0.0:
        policy_iteration(agent.stay_sum, agent.switch_sum, rules.gamma, agent.policy)


@compiled
def think(
    agent: Agent,
    rules: Rules,
    out: NDArray[np.void],
    known_by: int,
    xi: float,
    y: Float,
    t: int,
    uniforms: Float,
) -> None:
    """One iteration, after the gate's verdict and (if novel) the abstraction's update.

    When `out["saved"]` comes back true, the caller freezes the abstraction and then calls
    `begin_abstraction`; the agent's statistics are still those of the saved one.

    Args:
        agent: memory to change.
        rules: constants.
        out: (1,) of `OUTCOME`, written.
        known_by: the gate's verdict.
        xi: mean weight change over the block; unused unless novel.
        y: (n, J) output on the block; unused unless novel.
        t: frame after the block.
        uniforms: (3,) uniform draws: explore?, which action, which stream.
    """
    m = agent.memory[0]
    o = out[0]
    stream = m["stream"]
    novel = known_by == NOVEL
    o["stream"] = stream
    o["module"] = m["module"]
    o["novel"] = novel
    o["known_by"] = known_by
    o["saved"] = False
    o["roc_error_inst"] = math.nan
    o["xi"] = math.nan
    o["xi_dot"] = math.nan
    o["curiosity"] = math.nan
    o["expert"] = math.nan
    o["reward"] = math.nan
    m["share"] += ((1.0 if novel else 0.0) - m["share"]) * 2.0 / (rules.eta_dot_window + 1.0)
    if novel:
        m["novel_blocks"] += 1
        o["xi"] = xi
        if m["novel_blocks"] > 1:
            o["xi_dot"] = xi - m["xi"]
            if m["novel_blocks"] > rules.warm_up and m["last_stream"] >= 0:
                o["curiosity"] = curiosity_reward(xi, m["xi"])
                o["expert"] = expert_reward(xi, rules.sigma, rules.beta)
                o["reward"] = o["curiosity"] + o["expert"]
        m["xi"] = xi
        m["fed_stream"] = stream
        m["fed_until"] = t
        for j in range(y.shape[1]):
            track_output(agent, rules, j, y[:, j])
        agent.y_frames[0] += y.shape[0]
        if rules.tabular:
            o["roc_error_inst"] = track_clusters(agent, rules, stream, y)
        o["saved"] = ready_to_save(agent, rules)
    o["share"] = m["share"]
    o["novel_blocks"] = m["novel_blocks"]
    o["roc_error"] = m["roc_error"]
    if not o["saved"] and not math.isnan(o["reward"]):
        estimate_reward(agent, rules, stream, o["reward"])
    if o["saved"]:
        epsilon = rules.epsilon_start
        greedy = 0
    else:
        epsilon = decay(
            m["epsilon"], rules.epsilon_decay, rules.epsilon_knee, rules.epsilon_tail_decay
        )
        greedy = agent.policy[stream]
    m["epsilon"] = epsilon
    m["idle"] = m["idle"] + 1 if epsilon < IDLE_EPSILON else 0
    action, explored = choose(epsilon, greedy, uniforms[0], uniforms[1])
    following = other_stream(stream, len(agent.policy), uniforms[2]) if action == 1 else stream
    o["epsilon"] = epsilon
    o["explored"] = explored
    o["action"] = action
    o["next_stream"] = following
    m["last_stream"] = stream
    m["last_action"] = action
    m["stream"] = following
    m["iteration"] += 1
