"""Whole trials in compiled code: `CuriousLearner`'s own functions, no Python per block.

A trial gives bit for bit what `CuriousLearner.step` gives on the same source. It is for
sources that repeat, as the oscillatory streams do, so that one period in memory is all of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from cdmisfa.agents.agent import OUTCOME, Agent, Rules
from cdmisfa.agents.gate import Frozen
from cdmisfa.agents.iteration import iterate
from cdmisfa.agents.learner import CuriousLearner
from cdmisfa.agents.learners import open_learner
from cdmisfa.agents.policy import action_values
from cdmisfa.core.arithmetic.choice import in_own_arithmetic
from cdmisfa.core.arithmetic.compiled import compiled, spliced
from cdmisfa.core.blocks import freeze
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.errors import UsageError
from cdmisfa.core.expansion import expand
from cdmisfa.core.learning import Learner
from cdmisfa.core.modules import Module
from cdmisfa.experiments.loop import ending
from recorder.world.oscillatory import PERIOD, OscillatorySource, one_period

Float = NDArray[np.float64]
Int = NDArray[np.int64]

CHUNK = 512
"""Iterations between two returns to Python."""


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
    """What a trial came to; the words of `ended` are those of a run.

    Attributes:
        modules: what was learned, in order.
        iterations: iterations in all.
        frames: frames in all.
        final_policy: policy of the abstraction being learned at the end.
        epsilon: its probability of a random action.
        ended: "max_modules", "max_iterations" or "nothing_left".
        swapped: iteration from which on the swapped signal was shown; -1 never.
        curves: where asked for, what every iteration came to, an array a signal, named as in
            `BlockSignals` and equal to it: the fields of `OUTCOME` (N,), eta_dot (N, J), R (N, S)
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


_iterate = spliced(iterate)


@compiled
def run_iterations(
    agent: Agent,
    rules: Rules,
    out: NDArray[np.void],
    frozen: Frozen,
    feature: Any,
    frames: Float,
    x: Float,
    tau: int,
    clock: int,
    uniforms: Float,
    patience: int,
    swap_below: float,
    outcomes: NDArray[np.void],
    eta_dot: Float,
    R: Float,
    Q: Float,
    policy: Int,
) -> int:
    """Iterate until a module is to be saved, a swap is due, patience ends or the draws do.

    Args:
        agent: changed in place, as are out and feature.
        rules: constants.
        out: (1,) of `OUTCOME`.
        frozen: the frozen modules.
        feature: the adaptive abstraction's kernel.
        frames: (S, PERIOD + tau, I) one period of every stream and the block that overlaps it.
        x: the same, expanded.
        tau: frames of a block.
        clock: global counter of the next frame.
        uniforms: (N, 3) draws of N iterations.
        patience: iterations without epsilon after which nothing is left.
        swap_below: return when epsilon is below this.
        outcomes: (N,) of `OUTCOME`, written, as are the next; or all of length 0.
        eta_dot: (N, J).
        R: (N, S) stay entries.
        Q: (N, S, 2).
        policy: (N, S).

    Returns:
        Number of iterations done.
    """
    memory = agent.memory[0]
    modules, outputs = frozen.band_mean.shape
    y_frozen = np.empty((modules, tau, outputs))
    eta_frozen, roc_error_frozen = np.empty((modules, outputs)), np.empty(modules)
    no_output = np.full((tau, outputs), np.nan)
    for k in range(len(uniforms)):
        stream = memory["stream"]
        t = clock + k * tau
        start = t % PERIOD
        _iterate(
            agent,
            rules,
            out,
            frozen,
            feature,
            frames[stream, start : start + tau],
            x[stream, start : start + tau],
            1.0,
            t,
            uniforms[k],
            y_frozen,
            eta_frozen,
            roc_error_frozen,
            no_output,
        )
        if len(outcomes) > 0:
            outcomes[k] = out[0]
            eta_dot[k] = agent.eta_dot
            scale = memory["scale"] if memory["scale"] > 0.0 else 1.0
            for s in range(len(agent.policy)):
                R[k, s] = agent.stay_sum[s] / scale
                policy[k, s] = agent.policy[s]
            action_values(
                agent.stay_sum, agent.switch_sum, memory["scale"], rules.gamma, agent.policy, Q[k]
            )
        if out[0]["saved"] or memory["idle"] > patience or memory["epsilon"] < swap_below:
            return k + 1
    return len(uniforms)


def has_compiled_trials(config: Any) -> bool:
    """Whether the learner of a configuration, and what it learns with, has compiled code."""
    return _compiles(open_learner(config, OscillatorySource().spec, 0))


def _compiles(learner: Learner) -> TypeGuard[CuriousLearner]:
    return isinstance(learner, CuriousLearner) and learner.kernel is not None


@in_own_arithmetic
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
        max_iterations: end after so many.
        max_modules: end after so many modules; by default as many as there are streams.
        swap: an abrupt change.
        curves: keep what every iteration came to.

    Raises:
        UsageError: the learner, or the feature it learns with, has no compiled code.
    """
    learner = open_learner(config, OscillatorySource(streams).spec, seed)
    if not _compiles(learner):
        raise UsageError(
            f"learner.algorithm {config.algorithm} has no compiled trials: use learn for it"
        )
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
        pending = swap is not None and swapped < 0
        record = _records(len(drawn) if curves else 0, config.outputs, len(streams))
        done = run_iterations(
            learner.agent,
            learner.rules,
            learner.out,
            learner.frozen,
            learner.kernel,
            frames,
            x,
            config.tau,
            learner.iteration * config.tau,
            drawn,
            config.patience,
            swap.below if swap is not None and pending else -1.0,
            *record.values(),
        )
        uniforms = uniforms[done:]
        if curves:
            parts.append(_named(record, done))
        if learner.out["saved"][0]:
            learner.save_abstraction()
        elif swap is not None and pending and learner.epsilon < swap.below:
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


def _expand(config: LearnerConfig, tables: Sequence[Float]) -> tuple[Float, Float]:
    """One period of every stream and the tau frames after it, as shown and as learned from.

    Not to be written, as blocks are not: then what was compiled for learners serves trials, too.
    """
    index = np.arange(PERIOD + config.tau) % PERIOD
    frames = np.stack([table[index] for table in tables])
    return freeze(frames), freeze(np.stack([expand(config.expansion, table) for table in frames]))


def _records(n: int, outputs: int, streams: int) -> dict[str, NDArray[Any]]:
    return {
        "outcome": np.zeros(n, OUTCOME),
        "eta_dot": np.zeros((n, outputs)),
        "R": np.zeros((n, streams)),
        "Q": np.zeros((n, streams, 2)),
        "policy": np.zeros((n, streams), np.int64),
    }


def _named(record: Mapping[str, NDArray[Any]], done: int) -> dict[str, NDArray[Any]]:
    outcome = record["outcome"][:done]
    named = {name: outcome[name] for name in OUTCOME.names or ()}
    return named | {name: record[name][:done] for name in ("eta_dot", "R", "Q", "policy")}
