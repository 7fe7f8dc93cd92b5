"""Whole trials in C: what `CuriousLearner.step` calls, no Python per block.

A trial gives bit for bit what `CuriousLearner.step` gives on the same source. It is for
sources that repeat, as the oscillatory streams do, so that one period in memory is all of it.
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

# Iterations between two returns to Python.
CHUNK = 512


@dataclass(frozen=True, slots=True)
class Swap:
    """An abrupt change of the world: another signal on a stream from the next block on.

    Attributes:
        below: it happens once, when epsilon first falls below this.
        stream: index of the stream.
        name: the signal it shows from then on.
    """

    below: float
    stream: int
    name: str


@dataclass(frozen=True, slots=True)
class TrialResult:
    """Result of a trial.

    Attributes:
        modules: the learned modules, in order.
        iterations: the number of iterations.
        frames: the number of frames.
        final_policy: policy of the abstraction being learned at the end.
        epsilon: its probability of a random action.
        ended: why, as for a run: "max_modules", "max_iterations" or "nothing_left".
        swapped: the iteration from which on the swapped signal was shown; -1 never.
        curves: if asked for, the signals of all iterations as arrays, named as in `BlockSignals`
            and equal to it: the fields of `OUTCOME` (N,), eta_dot (N, J), R (N, S)
            of the stay entries, Q (N, S, 2) and policy (N, S).
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


def run_trial(
    config: LearnerConfig,
    streams: Sequence[str] = ("x1", "x2", "x3"),
    *,
    seed: int,
    max_iterations: int | None = None,
    max_modules: int | None = None,
    swap: Swap | None = None,
    curves: bool = False,
) -> TrialResult:
    """Learn from oscillatory streams until nothing is left to learn.

    Args:
        config: the learner's configuration.
        streams: signals the streams show.
        seed: seed of the policy and of the abstractions' first weights.
        max_iterations: end after this many.
        max_modules: end after this many modules; by default as many as there are streams.
        swap: an abrupt change.
        curves: keep the signals of all iterations.

    Raises:
        ValueError: the learner is in Python.
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
        left = CHUNK if max_iterations is None else max_iterations - learner.iteration
        drawn = uniforms[:left]
        record = _records(len(drawn), config.outputs, len(streams)) if curves else {}
        below = swap.below if swap is not None and swapped < 0 else -1.0
        done = learner.repeat(frames, x, drawn, below, _as_struct(record))
        uniforms = uniforms[done:]
        if curves:
            kept = {name: array[:done] for name, array in record.items()}
            outcome = kept.pop("outcome")
            parts.append({name: outcome[name] for name in OUTCOME.names or ()} | kept)
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
    """One period of every stream and the tau frames after it, as shown and as learned from."""
    index = np.arange(PERIOD + config.tau) % PERIOD
    frames = np.concatenate([table[index] for table in tables])
    return kernels.frames_of(frames), kernels.frames_of(expand(config.expansion, frames))


def _records(n: int, outputs: int, streams: int) -> dict[str, NDArray[Any]]:
    return {
        "outcome": np.zeros(n, OUTCOME),
        "eta_dot": np.zeros((n, outputs)),
        "R": np.zeros((n, streams)),
        "Q": np.zeros((n, streams, 2)),
        "policy": np.zeros((n, streams), np.int64),
    }


def _as_struct(record: Mapping[str, NDArray[Any]]) -> kernels.Struct | None:
    arrays = {
        name: kernels.records(name, array)
        if name == "outcome"
        else kernels.pointer(name, array, array.shape, array.dtype)
        for name, array in record.items()
    }
    return kernels.Struct("curves", {}, arrays) if record else None
