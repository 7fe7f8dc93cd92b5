"""Run trials on oscillatory streams entirely in C, without Python code for each block.

A trial gives bit for bit what `CuriousLearner.step` gives on the same source. It needs streams that
repeat, as the oscillatory streams do, so that one period of frames in memory is the whole source.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa import kernels
from cdmisfa.agents.agent import OUTCOME
from cdmisfa.agents.learner import CuriousLearner
from cdmisfa.agents.learners import open_learner
from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.expansion import expand
from cdmisfa.experiments.loop import ending
from cdmisfa.modules import Module
from recorder.world.oscillatory import PERIOD, OscillatorySource, one_period

# Iterations in one call of C. The number changes the speed only.
CHUNK = 512


@dataclass(frozen=True, slots=True)
class Swap:
    """Abrupt change of the world: a stream gets another signal from the next block on.

    Attributes:
        below: the swap happens once, when epsilon first falls below this value.
        stream: index of the stream.
        name: name of the new signal.
    """

    below: float
    stream: int
    name: str


@dataclass(frozen=True, slots=True)
class TrialResult:
    """Result of a trial.

    Attributes:
        modules: the saved modules.
        iterations: number of iterations.
        frames: number of frames.
        final_policy: policy at the end.
        epsilon: probability of a random action at the end.
        ended: reason for the end: "max_modules", "max_iterations" or "nothing_left".
        swapped: first iteration with the swapped signal; -1 if there was none.
        curves: None, or the signals of all iterations as arrays with the names and values of
            `BlockSignals`: the fields of `OUTCOME` (N,), eta_dot (N, J), R (N, S) of the stay
            entries, Q (N, S, 2) and policy (N, S).
    """

    modules: tuple[Module, ...]
    iterations: int
    frames: int
    final_policy: tuple[int, ...]
    epsilon: float
    ended: str
    swapped: int
    curves: Mapping[str, NDArray[Any]] | None


def has_whole_trials(config: Any) -> bool:
    """Return whether the learner of a configuration can run whole trials in C."""
    return isinstance(open_learner(config, OscillatorySource().spec, 0), CuriousLearner)


def run_oscillatory_trial(
    config: LearnerConfig,
    streams: Sequence[str] = ("x1", "x2", "x3"),
    *,
    seed: int,
    max_iterations: int | None = None,
    max_modules: int | None = None,
    swap: Swap | None = None,
    curves: bool = False,
) -> TrialResult:
    """Learn from oscillatory streams until the learner ends.

    Args:
        config: configuration of the learner.
        streams: names of the signals.
        seed: seed of the policy and of the initial weights.
        max_iterations: largest number of iterations.
        max_modules: largest number of modules; None: one for each stream.
        swap: an abrupt change, or None.
        curves: True to record the signals of all iterations.

    Raises:
        ValueError: the learner cannot run in C.
    """
    learner = open_learner(config, OscillatorySource(streams).spec, seed)
    if not isinstance(learner, CuriousLearner):
        raise ValueError(f"the learner {config.algorithm} has no whole trials")
    tables = [one_period(name) for name in streams]
    frames, x = _expand(config, tables)
    limit = max_modules if max_modules is not None else len(streams)
    parts: list[dict[str, NDArray[Any]]] = []
    uniforms = np.empty((0, 3))
    swapped = -1
    while not (ended := ending(learner, limit, max_iterations)):
        if not len(uniforms):
            uniforms = learner.policy_rng.random((CHUNK, 3))
        remaining = CHUNK if max_iterations is None else max_iterations - learner.iteration
        drawn = uniforms[:remaining]
        record = _records(len(drawn), config.outputs, len(streams)) if curves else {}
        below = swap.below if swap is not None and swapped < 0 else -1.0
        done = learner.repeat(frames, x, drawn, below, _as_struct(record))
        uniforms = uniforms[done:]
        if curves:
            signals = {name: array[:done] for name, array in record.items()}
            outcome = signals.pop("outcome")
            parts.append({name: outcome[name] for name in OUTCOME.names or ()} | signals)
        if learner.out["saved"][0]:
            learner.save_abstraction()
        elif swap is not None and learner.epsilon < below:
            tables[swap.stream] = one_period(swap.name)
            frames, x = _expand(config, tables)
            swapped = learner.iteration
    return TrialResult(
        modules=tuple(learner.modules),
        iterations=learner.iteration,
        frames=learner.iteration * config.tau,
        final_policy=tuple(learner.policy.tolist()),
        epsilon=learner.epsilon,
        ended=ended,
        swapped=swapped,
        curves={n: np.concatenate([p[n] for p in parts]) for n in parts[0]} if curves else None,
    )


def _expand(
    config: LearnerConfig, tables: Sequence[FloatArray]
) -> tuple[kernels.Struct, kernels.Struct]:
    """Return one period of every stream and the tau frames after it, raw and expanded."""
    index = np.arange(PERIOD + config.tau) % PERIOD
    frames = np.concatenate([table[index] for table in tables])
    return kernels.frames_of(frames), kernels.frames_of(expand(config.expansion, frames))


def _records(n: int, outputs: int, streams: int) -> dict[str, NDArray[Any]]:
    """Return empty arrays for the signals of n iterations; see `TrialResult.curves`."""
    return {
        "outcome": np.zeros(n, OUTCOME),
        "eta_dot": np.zeros((n, outputs)),
        "R": np.zeros((n, streams)),
        "Q": np.zeros((n, streams, 2)),
        "policy": np.zeros((n, streams), np.int64),
    }


def _as_struct(record: Mapping[str, NDArray[Any]]) -> kernels.Struct | None:
    """Return the arrays of `_records` as a C struct, or None if there are none."""
    arrays = {
        name: kernels.records(name, array)
        if name == "outcome"
        else kernels.pointer(name, array, array.shape, array.dtype)
        for name, array in record.items()
    }
    return kernels.Struct("curves", {}, arrays) if record else None
