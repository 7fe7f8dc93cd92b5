"""Compiled whole trials against the learner, block by block."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from cdmisfa.agents.learner import CuriousLearner
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.signals import BlockSignals
from cdmisfa.experiments.trial import CHUNK, Swap, TrialResult, run_oscillatory_trial
from recorder.world.oscillatory import OscillatorySource

QUICK = LearnerConfig(epsilon_decay=0.99, tau=50, eta_dot_window=20)
"""Learns its modules in a few hundred short iterations."""


def step_by_step(
    config: LearnerConfig,
    streams: tuple[str, ...],
    seed: int,
    iterations: int,
    swap: Swap | None = None,
) -> tuple[CuriousLearner, list[BlockSignals]]:
    source = OscillatorySource(streams)
    learner = CuriousLearner(config, source.spec, seed)
    signals: list[BlockSignals] = []
    for _ in range(iterations):
        signals.append(learner.step(source.take(learner.stream, learner.tau)))
        if swap is not None and learner.epsilon < swap.below and not signals[-1].saved:
            source.replace(swap.stream, swap.name)
            swap = None
    return learner, signals


def assert_equal(trial: TrialResult, learner: CuriousLearner, signals: list[BlockSignals]) -> None:
    assert trial.iterations == len(signals)
    assert trial.frames == len(signals) * learner.tau
    assert trial.final_policy == tuple(learner.policy)
    assert trial.epsilon == learner.epsilon
    assert len(trial.modules) == len(learner.modules)
    for ours, theirs in zip(trial.modules, learner.modules, strict=True):
        for field in dataclasses.fields(ours):
            np.testing.assert_array_equal(getattr(ours, field.name), getattr(theirs, field.name))
    assert trial.curves is not None
    for name, curve in trial.curves.items():
        stay = range(len(learner.policy))
        expected = [s.R[stay, 0, stay] if name == "R" else getattr(s, name) for s in signals]
        np.testing.assert_array_equal(curve, np.array(expected), err_msg=name)


@pytest.mark.parametrize("algorithm", ["2.0", "1.0"])
def test_trial_is_the_learner_bit_for_bit(algorithm: str) -> None:
    config = dataclasses.replace(QUICK, algorithm=algorithm, roc_error=0.3)
    trial = run_oscillatory_trial(config, seed=5, curves=True, max_iterations=2 * CHUNK + 7)
    assert trial.modules, "nothing was learned: the comparison would not cover a save"
    assert_equal(trial, *step_by_step(config, ("x1", "x2", "x3"), 5, trial.iterations))


def test_trial_is_the_learner_across_a_swap() -> None:
    swap = Swap(0.9, 0, "x1")
    trial = run_oscillatory_trial(
        QUICK, ("zero", "x2", "x3"), seed=1, curves=True, max_modules=2, swap=swap
    )
    assert trial.swapped > 0
    assert trial.curves is not None
    epsilon = trial.curves["epsilon"]
    assert epsilon[trial.swapped - 1] < 0.9 <= epsilon[trial.swapped - 2]
    assert np.all(
        trial.curves["known_by"][: trial.swapped][trial.curves["stream"][: trial.swapped] == 0]
        == -1
    )
    learner = step_by_step(QUICK, ("zero", "x2", "x3"), 1, trial.iterations, swap)
    assert_equal(trial, *learner)
