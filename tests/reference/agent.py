"""The curious agent in plain Python: what the kernels must come to, up to rounding.

Its memory is that of the learner, an `Agent`; its rules are those of `rules`.
"""

from __future__ import annotations

import math
from types import SimpleNamespace as Rules
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.agents.agent import CONSTANT, NOVEL, Agent, Frozen
from cdmisfa.core.arrays import FloatArray

CONSTANT_VARIANCE, BAND, FORGOTTEN, TIE, IDLE_EPSILON = 1e-12, 2.0, 0.5, 1e-12, 1e-3
STAY, SWITCH = 0, 1


def slowness(derivative_square: float, variance: float) -> float:
    return math.inf if variance <= 0 else math.sqrt(derivative_square / variance) / (2 * math.pi)


def block_moments(y: FloatArray) -> tuple[float, float, float]:
    """Mean, variance and mean squared difference of (n,)."""
    return y.mean(), (y - y[0]).var(), (np.diff(y) ** 2).mean()


def instantaneous_slowness(y: FloatArray) -> float:
    _, variance, derivative = block_moments(y)
    return slowness(derivative, variance)


def window_rate(window: float, count: float) -> float:
    return max(2 / (window + 1), 1 / count)


def is_constant(frames: NDArray[Any], scale: float) -> bool:
    values = frames * scale
    return bool(((values - values[0]).var(axis=0) <= CONSTANT_VARIANCE).all())


def verdict(
    y_frozen: FloatArray, band_mean: FloatArray, band_sd: FloatArray
) -> tuple[int, FloatArray]:
    """What knows a block by slowness, and the slowness (M, J)."""
    eta = np.array([[instantaneous_slowness(y) for y in module.T] for module in y_frozen])
    eta = eta.reshape(band_mean.shape)
    with np.errstate(invalid="ignore"):
        inside = (np.abs(eta - band_mean) <= BAND * band_sd).all(axis=1)
    return (int(np.argmax(inside)) + 1 if inside.any() else NOVEL), eta


def nearest(centres: FloatArray, counts: FloatArray, y: FloatArray) -> tuple[int, float]:
    """The centre (of (C, n, J)) nearest to y (n, J), or -1, and its distance."""
    distances = np.sqrt(((centres - y) ** 2).mean(axis=(1, 2)))
    distances[counts <= 0] = np.inf
    if not len(counts) or np.isinf(distances).all():
        return -1, math.sqrt((y**2).mean())
    return int(np.argmin(distances)), float(distances.min())


def cluster(
    centres: FloatArray, counts: FloatArray, label: int, y: FloatArray, radius: float, memory: float
) -> float:
    """Take y (n, J) into the node of its label, of (S, C, n, J) and (S, C)."""
    counts *= math.exp(-1 / memory)
    counts[counts < FORGOTTEN] = 0
    winner, error = nearest(centres[label], counts[label], y)
    if winner >= 0 and error <= radius:
        counts[label, winner] += 1
        centres[label, winner] += (y - centres[label, winner]) / counts[label, winner]
    else:
        place = np.argmin(counts[label])
        counts[label, place], centres[label, place] = 1, y
    return error


def known_to(
    centres: FloatArray, counts: FloatArray, label: int, y_frozen: FloatArray, threshold: float
) -> tuple[int, FloatArray]:
    """What knows a block by clusters, and the errors (M,)."""
    nodes = zip(centres[:, label], counts[:, label], y_frozen, strict=True)
    result = [nearest(*node) for node in nodes]
    error = np.array([math.nan if winner < 0 else distance for winner, distance in result])
    known = np.flatnonzero(error < threshold)
    return (int(known[0]) + 1 if len(known) else NOVEL), error


def recognise(
    agent: Agent, rules: Rules, frozen: Frozen, frames: NDArray[Any], x: FloatArray, scale: float
) -> tuple[int, FloatArray, FloatArray, FloatArray]:
    """What knows a block; outputs, slowness and clustering error of the modules."""
    M, J = frozen.band_mean.shape
    y = (x @ frozen.phi.T - frozen.offset).reshape(len(x), M, J).transpose(1, 0, 2)
    known_by, eta = verdict(y, frozen.band_mean, frozen.band_sd)
    error = np.full(M, np.nan)
    if rules.tabular:
        label = int(agent.memory["stream"][0])
        known_by, error = known_to(frozen.centres, frozen.counts, label, y, rules.roc_error)
    return (CONSTANT if is_constant(frames, scale) else known_by), y, eta, error


def converged(eta_dot: FloatArray, delta: float) -> bool:
    return bool((np.abs(eta_dot) < delta).all())


def track_output(agent: Agent, rules: Rules, j: int, y: FloatArray) -> None:
    n, blocks = len(y), agent.memory[0]["novel_blocks"]
    mean, variance, derivative = block_moments(y)
    square = variance + mean**2
    rate = min(1, max(2 * n / (rules.slowness_window + n), 1 / blocks))
    agent.derivative[j] += rate * (derivative - agent.derivative[j])
    agent.recent_mean[j] += rate * (mean - agent.recent_mean[j])
    agent.recent_square[j] += rate * (square - agent.recent_square[j])
    agent.y_sum[j] += mean * n
    agent.square_sum[j] += square * n
    frames = agent.y_frames[0] + n
    spread = agent.square_sum[j] / frames - (agent.y_sum[j] / frames) ** 2
    eta = slowness(agent.derivative[j], spread)
    change = abs(eta - agent.eta[j])
    agent.eta[j] = eta
    if math.isnan(agent.eta_dot[j]):
        agent.eta_dot[j] = change
    else:
        agent.eta_dot[j] += 2 / (rules.eta_dot_window + 1) * (change - agent.eta_dot[j])
    agent.eta_inst[j] = slowness(derivative, variance)
    if agent.eta_inst[j] < math.inf:
        weight = window_rate(rules.gate_window, blocks)
        step = agent.eta_inst[j] - agent.gate_mean[j]
        agent.gate_mean[j] += weight * step
        agent.gate_variance[j] = (1 - weight) * (agent.gate_variance[j] + weight * step**2)


def ready_to_save(agent: Agent, rules: Rules) -> bool:
    m = agent.memory[0]
    alive = (agent.recent_square - agent.recent_mean**2 >= rules.min_variance).all()
    if m["novel_blocks"] <= rules.eta_dot_window or m["share"] < rules.novel_share or not alive:
        return False
    settled = converged(agent.eta_dot, rules.delta)
    return bool(m["roc_error"] < rules.roc_error) if rules.tabular else settled


def expert_reward(xi: float, sigma: float, beta: float) -> float:
    return beta * math.exp(-(xi**2) / (2 * sigma**2)) if sigma > 0 else 0.0


def curiosity_reward(xi: float, xi_previous: float) -> float:
    return xi_previous - xi


def add_reward(
    stay: FloatArray, switch: FloatArray, dense: FloatArray, s: int, a: int, s_next: int, r: float
) -> None:
    (switch if a == SWITCH else stay)[s] += r
    if len(dense):
        dense[s, a, s_next] += r


def add_reward_locally(
    stay: FloatArray,
    switch: FloatArray,
    dense: FloatArray,
    s: int,
    a: int,
    s_next: int,
    r: float,
    alpha: float,
) -> float:
    dense[s, a, s_next] += alpha * (r - dense[s, a, s_next])
    stay[s], switch[s] = dense[s, STAY, s], dense[s, SWITCH].sum()
    return float(np.linalg.norm(dense))


def value_sum(
    stay: FloatArray, switch: FloatArray, policy: NDArray[np.int64], gamma: float
) -> float:
    n, leavers = len(stay), int(policy.sum())
    values = np.where(policy == SWITCH, switch, stay * ((n - 1 + gamma) / (1 - gamma)))
    return float(values.sum() / (n - leavers + (leavers - 1) * (1 - gamma)))


def policy_iteration(
    stay: FloatArray, switch: FloatArray, gamma: float, policy: NDArray[np.int64], sweeps: int = 100
) -> None:
    """Make a policy optimal, in place."""
    n = len(stay)
    if n == 1:
        policy[0] = STAY
        return
    share = gamma / (n - 1)
    for _ in range(sweeps):
        before, total = policy.copy(), value_sum(stay, switch, policy, gamma)
        keep, leave = stay / (1 - gamma), (switch / (n - 1) + share * total) / (1 + share)
        policy[:] = leave - keep > TIE * (np.abs(leave) + np.abs(keep))
        if (policy == before).all():
            return


def action_values(
    stay: FloatArray, switch: FloatArray, count: float, gamma: float, policy: NDArray[np.int64]
) -> FloatArray:
    """Values of both actions under a policy, (S, 2)."""
    n = len(stay)
    if not count > 0:
        return np.zeros((n, 2))
    if n == 1:
        return np.full((1, 2), stay[0] / count / (1 - gamma))
    share = gamma / (n - 1)
    arrive = switch / count / (n - 1) + share * value_sum(stay, switch, policy, gamma) / count
    value = np.where(policy == SWITCH, arrive / (1 + share), stay / count / (1 - gamma))
    return np.stack([stay / count + gamma * value, arrive - share * value], axis=1)


def decay(epsilon: float, slow: float, knee: float, fast: float) -> float:
    return epsilon * (slow if epsilon > knee else fast)


def choose(epsilon: float, greedy: int, coin: float, draw: float) -> tuple[int, bool]:
    return (int(draw >= 0.5), True) if coin < epsilon else (greedy, False)


def other_stream(stream: int, n_streams: int, draw: float) -> int:
    if n_streams == 1:
        return stream
    return (stream + 1 + min(int(draw * (n_streams - 1)), n_streams - 2)) % n_streams


def mean_change(xi: FloatArray) -> float:
    finite = xi[~np.isnan(xi)]
    return float(finite.mean()) if len(finite) else math.nan


def has_gap(memory: NDArray[np.void], stream: int, t: int) -> bool:
    m = memory[0]
    return bool(m["fed_stream"] != stream or m["fed_until"] != t)


def estimate_reward(agent: Agent, rules: Rules, reward: float) -> None:
    m = agent.memory[0]
    sums = agent.stay_sum, agent.switch_sum, agent.dense
    transition = m["last_stream"], m["last_action"], m["stream"]
    m["rewards"] += 1
    if rules.tabular:
        m["scale"] = add_reward_locally(*sums, *transition, reward, rules.alpha)
    else:
        add_reward(*sums, *transition, reward)
        m["scale"] = m["rewards"]
    if m["scale"] > 0:
        policy_iteration(agent.stay_sum, agent.switch_sum, rules.gamma, agent.policy)


def think(
    agent: Agent,
    rules: Rules,
    known_by: int,
    xi: FloatArray,
    y: FloatArray,
    t: int,
    uniforms: FloatArray,
) -> dict[str, Any]:
    """One iteration after the gate and the update; what `OUTCOME` tells of it."""
    m = agent.memory[0]
    stream, novel = int(m["stream"]), known_by == NOVEL
    o: dict[str, Any] = {"stream": stream, "module": int(m["module"]), "novel": novel}
    o |= {"known_by": known_by, "saved": False, "roc_error_inst": math.nan}
    o |= dict.fromkeys(("xi", "xi_dot", "curiosity", "expert", "reward"), math.nan)
    stayed = float(novel and m["last_stream"] == stream)
    m["share"] += (stayed - m["share"]) * 2 / (rules.eta_dot_window + 1)
    if novel:
        m["novel_blocks"] += 1
        change = o["xi"] = mean_change(xi)
        if m["novel_blocks"] > 1:
            o["xi_dot"] = change - m["xi"]
            if m["novel_blocks"] > rules.warm_up and m["last_stream"] >= 0:
                o["curiosity"] = curiosity_reward(change, m["xi"])
                o["expert"] = expert_reward(change, rules.sigma, rules.beta)
                o["reward"] = o["curiosity"] + o["expert"]
        m["xi"], m["fed_stream"], m["fed_until"] = change, stream, t + len(y)
        for j in range(y.shape[1]):
            track_output(agent, rules, j, y[:, j])
        agent.y_frames[0] += len(y)
        if rules.tabular:
            error = o["roc_error_inst"] = cluster(
                agent.centres, agent.counts, stream, y, rules.roc_radius, rules.roc_memory
            )
            rate = window_rate(rules.eta_dot_window, m["novel_blocks"])
            mean = m["roc_error"]
            m["roc_error"] = error if math.isnan(mean) else mean + rate * (error - mean)
        o["saved"] = ready_to_save(agent, rules)
    o |= {name: m[name] for name in ("share", "novel_blocks", "roc_error")}
    if not o["saved"] and not math.isnan(o["reward"]):
        estimate_reward(agent, rules, o["reward"])
    factors = rules.epsilon_decay, rules.epsilon_knee, rules.epsilon_tail_decay
    m["epsilon"] = rules.epsilon_start if o["saved"] else decay(m["epsilon"], *factors)
    m["idle"] = m["idle"] + 1 if m["epsilon"] < IDLE_EPSILON else 0
    greedy = STAY if o["saved"] else int(agent.policy[stream])
    action, o["explored"] = choose(m["epsilon"], greedy, uniforms[0], uniforms[1])
    m["stream"] = other_stream(stream, len(agent.policy), uniforms[2]) if action else stream
    o |= {"epsilon": float(m["epsilon"]), "action": action, "next_stream": int(m["stream"])}
    m["last_stream"], m["last_action"] = stream, action
    m["iteration"] += 1
    return o
