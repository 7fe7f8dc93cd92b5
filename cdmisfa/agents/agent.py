"""The curiosity-driven agent: what it remembers, and the rules it goes by."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cdmisfa import kernels
from cdmisfa.core.arrays import FloatArray, IntArray
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.errors import UsageError
from cdmisfa.core.signals import DENSE_STREAMS

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
        ("share", "f8"),  # running share of novel blocks of the stream of the block before
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
    ],
    align=True,
)
"""Both as `kernels.h` has them."""


class Agent(NamedTuple):
    """The agent's memory, as arrays only: saving them saves everything.

    memory: (1,) of `MEMORY`. Per output (J,): eta, eta_dot, eta_inst, gate_mean, gate_variance,
    the running E(ydot^2) derivative, the sums y_sum and square_sum over y_frames (1,) frames, and
    the recent moments recent_mean, recent_square. Per stream: stay_sum, switch_sum, policy (S,),
    dense (S, 2, S) or (0, 2, 0). CD-MISFA 1.0 only, else empty: the clustering's
    centres (S, C, tau, J) and counts (S, C).
    """

    memory: NDArray[np.void]
    eta: FloatArray
    eta_dot: FloatArray
    eta_inst: FloatArray
    gate_mean: FloatArray
    gate_variance: FloatArray
    derivative: FloatArray
    y_sum: FloatArray
    square_sum: FloatArray
    y_frames: IntArray
    recent_mean: FloatArray
    recent_square: FloatArray
    stay_sum: FloatArray
    switch_sum: FloatArray
    dense: FloatArray
    policy: IntArray
    centres: FloatArray
    counts: FloatArray


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
    patience: float


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


def begin_abstraction(agent: Agent, epsilon_start: float) -> None:
    """Forget everything that belongs to the abstraction before; all statistics start anew."""
    for array in agent[1:]:
        array[...] = 0
    for array in (agent.eta, agent.eta_dot, agent.eta_inst):
        array[...] = math.nan
    m = agent.memory[0]
    m["module"] += 1
    m["fed_stream"] = m["fed_until"] = -1
    m["novel_blocks"] = m["rewards"] = m["idle"] = 0
    m["scale"] = 0.0
    m["roc_error"] = m["xi"] = math.nan
    m["share"] = 1.0
    m["epsilon"] = epsilon_start


def as_struct(agent: Agent, told: Rules, out: NDArray[np.void]) -> kernels.Struct:
    """An agent as the kernels take it: its arrays, its rules, and where its outcome goes.

    Args:
        agent: changed in place.
        told: its rules.
        out: (1,) of `OUTCOME`, written.
    """
    sizes = {
        "streams": len(agent.policy),
        "outputs": len(agent.eta),
        "tau": agent.centres.shape[2],
        "tensor": len(agent.dense),
        "places": agent.counts.shape[1],
    }
    rules = kernels.Struct("rules", told._asdict(), {})
    arrays = {"rules": rules.pointer, "out": kernels.records("outcome", out)}
    arrays["memory"] = kernels.records("memory", agent.memory)
    for name, array in zip(agent._fields[1:], agent[1:], strict=True):
        arrays[name] = kernels.pointer(name, array, array.shape, array.dtype)
    return kernels.Struct("agent", sizes, arrays)
