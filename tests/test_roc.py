"""Clustering and rewards of CD-MISFA 1.0."""

from __future__ import annotations

import math

import numpy as np
import pytest
from reference import agent as roc

from cdmisfa.agents.learner import CuriousLearner
from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.errors import UsageError
from cdmisfa.experiments.trial import run_oscillatory_trial
from recorder.world.oscillatory import OscillatorySource


def node(streams: int = 2, places: int = 3, n: int = 4) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros((streams, places, n, 1)), np.zeros((streams, places))


def block(value: float, n: int = 4) -> np.ndarray:
    return np.full((n, 1), value)


def test_an_empty_node_is_as_far_as_the_output_is_large() -> None:
    centres, counts = node()
    assert roc.nearest(centres[0], counts[0], block(3.0)) == (-1, 3.0)


def test_repeated_outputs_become_centres_and_their_errors_vanish() -> None:
    centres, counts = node()
    first = [roc.cluster(centres, counts, 0, block(v), 0.3, 40.0) for v in (1.0, -1.0, 5.0)]
    assert first == [1.0, 2.0, 4.0]
    again = [roc.cluster(centres, counts, 0, block(v), 0.3, 40.0) for v in (1.0, -1.0, 5.0)]
    assert again == [0.0, 0.0, 0.0]
    assert not counts[1].any()


def test_a_block_is_known_to_the_first_module_that_is_near_under_its_label() -> None:
    centres, counts = node()
    roc.cluster(centres, counts, 0, block(1.0), 0.3, 40.0)
    stack, seen = np.stack([centres, centres]), np.stack([counts, counts])
    outputs = np.stack([block(7.0), block(1.05)])
    for threshold, known_by in ((0.1, 2), (10.0, 1), (0.01, 0)):
        result, error = roc.known_to(stack, seen, 0, outputs, threshold)
        assert result == known_by
        np.testing.assert_allclose(error, [6.0, 0.05])
    result, error = roc.known_to(stack, seen, 1, outputs, 0.1)
    assert result == 0
    assert np.isnan(error).all()


def test_a_local_reward_changes_one_entry_and_the_norm() -> None:
    stay, switch, dense = np.zeros(3), np.zeros(3), np.zeros((3, 2, 3))
    roc.add_reward_locally(stay, switch, dense, 0, 0, 0, 1.0, 0.5)
    roc.add_reward_locally(stay, switch, dense, 1, 1, 0, 2.0, 0.5)
    norm = roc.add_reward_locally(stay, switch, dense, 1, 1, 2, -4.0, 0.5)
    assert np.count_nonzero(dense) == 3
    np.testing.assert_array_equal(stay, [0.5, 0, 0])
    np.testing.assert_array_equal(switch, [0, 1.0 - 2.0, 0])
    assert norm == pytest.approx(math.sqrt(0.25 + 1 + 4))


def test_1_0_learns_modules_and_its_reward_function_has_norm_1() -> None:
    source = OscillatorySource()
    learner = CuriousLearner(LearnerConfig(algorithm="1.0", warm_up=20), source.spec, 0)
    for _ in range(60):
        signals = learner.step(source.take(learner.stream, learner.tau))
    assert np.linalg.norm(signals.R) == pytest.approx(1.0)
    trial = run_oscillatory_trial(LearnerConfig(algorithm="1.0"), seed=0, max_iterations=3000)
    assert trial.modules
    assert trial.modules[0].counts.any()


def test_the_clustering_errors_are_recorded_and_decide() -> None:
    source = OscillatorySource()
    config = LearnerConfig(algorithm="1.0", roc_error=0.3, eta_dot_window=20)
    learner = CuriousLearner(config, source.spec, 5)
    saved, after = [], []
    while len(learner.modules) < 2:
        count, novel_blocks = len(learner.modules), int(learner.agent.memory["novel_blocks"][0])
        signals = learner.step(source.take(learner.stream, learner.tau))
        assert signals.roc_error_frozen.shape == (count,)
        assert math.isnan(signals.roc_error_inst) == (not signals.novel)
        if signals.novel and not novel_blocks:
            assert signals.roc_error == signals.roc_error_inst
        if signals.saved:
            assert signals.roc_error < 0.3
            saved.append(signals.iteration)
        if count:
            near = signals.roc_error_frozen[0] < 0.3
            assert signals.known_by == int(near)
            after.append(near)
    assert len(saved) == 2
    assert 0 < sum(after) < len(after)


def test_1_0_can_learn_the_paper_s_modules_too() -> None:
    config = LearnerConfig(algorithm="1.0")
    trials = [
        run_oscillatory_trial(config, seed=seed, max_iterations=6000) for seed in range(1000, 1006)
    ]
    assert sum([m.stream_index for m in trial.modules] == [0, 1, 2] for trial in trials) >= 3


def test_1_0_refuses_more_streams_than_its_table_has() -> None:
    spec = SourceSpec(tuple(f"s{i}" for i in range(65)), (2,), "float64")
    with pytest.raises(UsageError, match="give at most 64"):
        CuriousLearner(LearnerConfig(algorithm="1.0"), spec, 0)
