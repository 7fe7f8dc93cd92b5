"""The curiosity-driven agent: its memory, its rules, and its gate of frozen modules."""

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
    """Return the type of arrays of records, as C has them."""
    types = {"int64_t": "i8", "double": "f8", "_Bool": "?"}
    fields = dict(kernels.ffi.typeof(kind).fields)
    layout: Any = {
        "names": list(fields),
        "formats": [types[field.type.cname] for field in fields.values()],
        "offsets": [field.offset for field in fields.values()],
        "itemsize": kernels.ffi.sizeof(kind),
    }
    made: np.dtype[np.void] = np.dtype(layout)
    return made


# Numbers that the agent remembers:
# iteration    iterations so far
# module       abstraction being learned, from 1
# stream       stream to watch next
# last_stream, last_action   before and at the last decision; -1 before the first
# fed_stream, fed_until      stream of the last novel block (-1: none), and the frame after it
# novel_blocks since the abstraction was created
# rewards      t of the running reward function
# scale        divides the sums to give R; 0 before the first reward
# roc_error    CD-MISFA 1.0: running mean of the clustering error
# xi           mean change of the weights in the last novel block
# share        running share of novel blocks of the stream of the block before
# epsilon      probability of a random action
# idle         iterations with epsilon practically 0
MEMORY = _record_type("memory")

# Outcome of an iteration: signals of `BlockSignals` by their names.
OUTCOME = _record_type("outcome")

# Verdicts of the gate: no frozen module knows the block, or it carries nothing to learn. Positive
# verdicts are the module's index.
NOVEL: int = kernels.lib.NOVEL
CONSTANT: int = kernels.lib.CONSTANT


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


def rules(config: LearnerConfig, n_streams: int) -> SimpleNamespace:
    """Return the values of a configuration that an iteration with n streams needs, by name."""
    beta, tabular = config.reward_beta(n_streams), int(config.algorithm == "1.0")
    names = {name for name, _ in kernels.ffi.typeof("rules").fields} - {"beta", "tabular"}
    values = {name: float(getattr(config, name)) for name in names}
    return SimpleNamespace(**values, beta=beta, tabular=tabular)


def new_agent(config: LearnerConfig, n_streams: int, first_stream: int) -> Agent:
    """Return an agent that has seen nothing and will watch `first_stream`.

    Raises:
        UsageError: more streams than CD-MISFA 1.0's table of rewards is kept for.
    """
    tabular, dense = config.algorithm == "1.0", n_streams
    if n_streams > DENSE_STREAMS:
        dense = 0
        if tabular:
            raise UsageError(f"learner.algorithm 1.0 takes at most {DENSE_STREAMS} streams")
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
    """Forget everything that belongs to the abstraction before; all statistics start again."""
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
    """Return an agent as the kernels take it: its arrays, its rules, and where its outcome goes.

    Args:
        agent: changed in place.
        rules: see `rules`.
        out: (1,) of `OUTCOME`, written.
    """
    sizes = {
        "streams": len(agent.policy),
        "outputs": len(agent.eta),
        "tau": agent.centres.shape[2],
        "tensor": len(agent.dense),
        "places": agent.counts.shape[1],
    }
    numbers = kernels.Struct("rules", vars(rules), {})
    arrays = {"rules": numbers.pointer, "out": kernels.records("outcome", out)}
    arrays["memory"] = kernels.records("memory", agent.memory)
    for name, array in zip(agent._fields[1:], agent[1:], strict=True):
        arrays[name] = kernels.pointer(name, array, array.shape, array.dtype)
    return kernels.Struct("agent", sizes, arrays)


class Frozen(NamedTuple):
    """All frozen modules in one stack, so that one pass over a block serves them all.

    Attributes:
        phi: (M J, I) weights.
        offset: (M J,) phi times the mean.
        band_mean: (M, J) centres of the bands of known slowness.
        band_sd: (M, J) their standard deviations.
        centres: (M, S, C, n, J) clusters; (M, 0, 0, n, J) but for CD-MISFA 1.0.
        counts: (M, S, C).
    """

    phi: FloatArray
    offset: FloatArray
    band_mean: FloatArray
    band_sd: FloatArray
    centres: FloatArray
    counts: FloatArray

    @property
    def struct(self) -> kernels.Struct:
        """The stack as the kernels take it."""
        arrays = {n: kernels.pointer(n, a, a.shape) for n, a in self._asdict().items()}
        sizes = {"modules": len(self.band_mean), "inputs": self.phi.shape[1]}
        return kernels.Struct("frozen", sizes, arrays)


def frozen_modules(modules: Sequence[Module], agent: Agent, n_inputs: int) -> Frozen:
    """Return the modules of an agent whose abstractions have I = `n_inputs`."""
    count, outputs = len(modules), len(agent.eta)
    return Frozen(
        phi=np.array([m.phi for m in modules]).reshape(count * outputs, n_inputs),
        offset=np.array([kernels.mean_output(m.phi, m.mean) for m in modules]).reshape(-1),
        band_mean=np.array([m.band_mean for m in modules]).reshape(count, outputs),
        band_sd=np.array([m.band_sd for m in modules]).reshape(count, outputs),
        centres=np.array([m.centres for m in modules]).reshape(count, *agent.centres.shape),
        counts=np.array([m.counts for m in modules]).reshape(count, *agent.counts.shape),
    )
