"""The paper's agent: its memory, its rules, and the stack of saved modules that its gate uses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cdmisfa import kernels
from cdmisfa.core.arrays import FloatArray, IntArray
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.errors import UsageError
from cdmisfa.core.signals import DENSE_STREAMS
from cdmisfa.modules import Module


def _record_type(kind: str) -> np.dtype[np.void]:
    """Return the numpy type of a C record."""
    types = {"int64_t": "i8", "double": "f8", "_Bool": "?"}
    fields = dict(kernels.ffi.typeof(kind).fields)
    layout: Any = {
        "names": list(fields),
        "formats": [types[field.type.cname] for field in fields.values()],
        "offsets": [field.offset for field in fields.values()],
        "itemsize": kernels.ffi.sizeof(kind),
    }
    record: np.dtype[np.void] = np.dtype(layout)
    return record


# Scalars of the agent's memory:
# iteration    number of iterations done
# module       number of the module being learned, from 1
# stream       index of the next stream
# last_stream, last_action   stream and action of the last decision; -1 before the first
# fed_stream, fed_until      stream of the last novel block (-1: none), and the frame after it
# novel_blocks number of novel blocks since the last module was saved
# rewards      number of rewards in the running reward function
# scale        divides the reward sums to give R; 0 before the first reward
# roc_error    CD-MISFA 1.0: running mean of the clustering error
# xi           mean change of the weights in the last novel block
# share        running share of blocks that were novel and of the same stream as the block before
# epsilon      probability of a random action
# idle         number of iterations with epsilon practically 0
MEMORY = _record_type("memory")

# Outcome of an iteration: the scalar signals of `BlockSignals`, by name.
OUTCOME = _record_type("outcome")

# Results of the gate: no saved module explains the block, or the block is constant. Positive
# results are the number of the module that explains it.
NOVEL: int = kernels.lib.NOVEL
CONSTANT: int = kernels.lib.CONSTANT


class Agent(NamedTuple):
    """The agent's memory; it consists of arrays only, so that saving them saves everything.

    `memory` is (1,) of `MEMORY`. For each output (J,): eta, eta_dot, eta_inst, gate_mean,
    gate_variance, the running E(ydot^2) `derivative`, the sums y_sum and square_sum over y_frames
    (1,) frames, and the recent moments recent_mean and recent_square. For each stream: stay_sum,
    switch_sum and policy (S,), dense (S, 2, S) or (0, 2, 0). For CD-MISFA 1.0, else empty: cluster
    centres (S, C, tau, J) and their counts (S, C).
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


def rules(config: LearnerConfig, n_streams: int) -> SimpleNamespace:
    """Return the values of a configuration that an iteration needs, by name."""
    beta, tabular = config.reward_beta(n_streams), int(config.algorithm == "1.0")
    names = {name for name, _ in kernels.ffi.typeof("rules").fields} - {"beta", "tabular"}
    values = {name: float(getattr(config, name)) for name in names}
    return SimpleNamespace(**values, beta=beta, tabular=tabular)


def new_agent(config: LearnerConfig, n_streams: int, first_stream: int) -> Agent:
    """Return an agent before its first block, which takes that block from `first_stream`.

    Raises:
        UsageError: CD-MISFA 1.0 has more streams than its table of rewards holds.
    """
    tabular, dense = config.algorithm == "1.0", n_streams
    if n_streams > DENSE_STREAMS:
        dense = 0
        if tabular:
            raise UsageError(f"learner.algorithm 1.0: give at most {DENSE_STREAMS} streams")
    clusters = (n_streams, config.roc_centres) if tabular else (0, 0)
    arrays: dict[str, Any] = {
        "memory": np.zeros(1, MEMORY),
        "y_frames": np.zeros(1, np.int64),
        "stay_sum": np.zeros(n_streams),
        "switch_sum": np.zeros(n_streams),
        "dense": np.zeros((dense, 2, dense)),
        "policy": np.zeros(n_streams, np.int64),
        "centres": np.zeros((*clusters, config.tau, config.outputs)),
        "counts": np.zeros(clusters),
    }
    agent = Agent(**{n: arrays.get(n, np.zeros(config.outputs)) for n in Agent._fields})
    agent.memory["last_stream"], agent.memory["stream"] = -1, first_stream
    begin_abstraction(agent, config.epsilon_start)
    return agent


def begin_abstraction(agent: Agent, epsilon_start: float) -> None:
    """Reset the memory of the previous module, and start all statistics again."""
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


def as_struct(agent: Agent, rules: SimpleNamespace, out: NDArray[np.void]) -> kernels.Struct:
    """Return an agent as C takes it: its arrays, its rules, and the record of the outcome.

    Args:
        agent: the agent, changed in place by the kernels.
        rules: see `rules`.
        out: (1,) of `OUTCOME`, written by the kernels.
    """
    S, J, tau, dense = len(agent.policy), len(agent.eta), agent.centres.shape[2], len(agent.dense)
    labels, places = agent.counts.shape
    kernels.expect_some(streams=S, outputs=J, tau=tau)
    kernels.expect("dense and labels", dense in (0, S) and labels in (0, S), True)
    kernels.expect("memory and out", (agent.memory.shape, out.shape), ((1,), (1,)))
    sizes = {"streams": S, "outputs": J, "tau": tau, "tensor": dense, "places": places}
    shapes: dict[str, tuple[int, ...]] = {
        **dict.fromkeys(("stay_sum", "switch_sum", "policy"), (S,)),
        "y_frames": (1,),
        "dense": (dense, 2, dense),
        "centres": (labels, places, tau, J),
        "counts": (labels, places),
    }
    numbers = kernels.Struct("rules", vars(rules), {})
    arrays = {"rules": numbers.pointer, "out": kernels.records("outcome", out)}
    arrays["memory"] = kernels.records("memory", agent.memory)
    for name, array in zip(agent._fields[1:], agent[1:], strict=True):
        kind = kernels.INT64 if name in ("y_frames", "policy") else kernels.FLOAT64
        arrays[name] = kernels.pointer(name, array, shapes.get(name, (J,)), kind)
    return kernels.Struct("agent", sizes, arrays)


class Frozen(NamedTuple):
    """The saved modules in one stack, so that one pass over a block computes all outputs.

    Attributes:
        phi: (M J, I) weights.
        offset: (M J,) outputs on the mean of the frames.
        band_mean: (M, J) mean of the slowness in a block, when the module was saved.
        band_sd: (M, J) standard deviation of it.
        centres: (M, S, C, tau, J) cluster centres; (M, 0, 0, tau, J) except for CD-MISFA 1.0.
        counts: (M, S, C) counts of the clusters.
    """

    phi: FloatArray
    offset: FloatArray
    band_mean: FloatArray
    band_sd: FloatArray
    centres: FloatArray
    counts: FloatArray

    @property
    def struct(self) -> kernels.Struct:
        """The stack as C takes it."""
        arrays = {n: kernels.pointer(n, a, a.shape) for n, a in self._asdict().items()}
        sizes = {"modules": len(self.band_mean), "inputs": self.phi.shape[1]}
        return kernels.Struct("frozen", sizes, arrays)


def frozen_modules(modules: Sequence[Module], agent: Agent, n_inputs: int) -> Frozen:
    """Return the stack of an agent's modules, whose frames have I = `n_inputs` values."""
    count, outputs = len(modules), len(agent.eta)
    return Frozen(
        phi=np.array([m.phi for m in modules]).reshape(count * outputs, n_inputs),
        offset=np.array([kernels.mean_output(m.phi, m.mean) for m in modules]).reshape(-1),
        band_mean=np.array([m.band_mean for m in modules]).reshape(count, outputs),
        band_sd=np.array([m.band_sd for m in modules]).reshape(count, outputs),
        centres=np.array([m.centres for m in modules]).reshape(count, *agent.centres.shape),
        counts=np.array([m.counts for m in modules]).reshape(count, *agent.counts.shape),
    )
