"""One iteration of the agent: from the frames it watched to what it watches next.

`iterate` is written once and runs in two ways: as it is, with any feature, in
`CuriousLearner.step`; compiled, with features that have a kernel, in whole trials. An iteration
costs O(streams).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.agents.agent import Agent, Rules
from cdmisfa.agents.exploration import choose, decay, other_stream
from cdmisfa.agents.gate import NOVEL, Frozen, recognise
from cdmisfa.agents.policy import policy_iteration
from cdmisfa.agents.reward import add_reward, add_reward_locally, curiosity_reward, expert_reward
from cdmisfa.agents.saving import ready_to_save, track_clusters, track_output
from cdmisfa.core.arithmetic.compiled import compiled
from cdmisfa.features.feature import feed
from cdmisfa.features.projection import mean_output, outputs

Float = NDArray[np.float64]

IDLE_EPSILON = 1e-3
"""Below this the agent practically no longer explores."""


def iterate(
    agent: Agent,
    rules: Rules,
    out: NDArray[np.void],
    frozen: Frozen,
    feature: Any,
    frames: NDArray[Any],
    x: NDArray[Any],
    scale: float,
    t: int,
    uniforms: Float,
    y_frozen: Float,
    eta_inst_frozen: Float,
    roc_error_frozen: Float,
    no_output: Float,
) -> Float:
    """One iteration: known or novel, learn where it is novel, think.

    When `out["saved"]` comes back true, the caller freezes the feature; see `think`.

    Args:
        agent: memory to change.
        rules: constants.
        out: (1,) of `OUTCOME`, written.
        frozen: the frozen modules.
        feature: the adaptive abstraction, a `Feature`; its kernel in compiled code.
        frames: (n, I) the block of the agent's stream, as `as_frames` gives it.
        x: (n, I') the same, expanded.
        scale: factor from a frame's values to the learner's (1/255 for pixels).
        t: frame at which the block begins.
        uniforms: (3,) uniform draws, see `think`.
        y_frozen: (M, n, J) written: outputs of the frozen modules.
        eta_inst_frozen: (M, J) written: their instantaneous slowness.
        roc_error_frozen: (M,) written: their clustering error.
        no_output: (n, J) of NaN.

    Returns:
        (n, J) outputs of the feature; `no_output` where the block is not novel.
    """
    stream = int(agent.memory[0]["stream"])
    known_by = recognise(
        frozen,
        rules.roc_error,
        stream,
        frames,
        x,
        scale,
        y_frozen,
        eta_inst_frozen,
        roc_error_frozen,
    )
    xi, y = math.nan, no_output
    if known_by == NOVEL:
        xi = mean_change(feed(feature, x, has_gap(agent.memory, stream, t)))
        y = outputs(feature.phi, mean_output(feature.phi, feature.mean), x)
    think(agent, rules, out, known_by, xi, y, t + len(x), uniforms)
    return y


@compiled
def has_gap(memory: NDArray[np.void], stream: int, t: int) -> bool:
    """Whether a novel block does not continue the last novel one frame by frame."""
    m = memory[0]
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
    stayed = novel and m["last_stream"] == stream
    m["share"] += ((1.0 if stayed else 0.0) - m["share"]) * 2.0 / (rules.eta_dot_window + 1.0)
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
