"""Rules of the reference: rewards, their running mean, epsilon, actions, where a switch leads."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from reference.agent import add_reward, curiosity_reward, expert_reward, other_stream

from cdmisfa.core.config import LearnerConfig

small = st.floats(-1, 1)
unit = st.floats(0, 1, exclude_max=True)


@st.composite
def histories(draw: st.DrawFn) -> tuple[int, list[tuple[int, int, int, float]]]:
    n = draw(st.integers(1, 6))
    stream = st.integers(0, n - 1)
    reward = st.tuples(stream, st.integers(0, 1), stream, small)
    return n, draw(st.lists(reward, min_size=1, max_size=40))


def test_rewards_of_the_expert_and_of_curiosity() -> None:
    assert expert_reward(0.0, 0.01, 0.3) == 0.3
    assert expert_reward(0.01, 0.01, 0.3) == pytest.approx(0.3 * math.exp(-0.5))
    assert expert_reward(-0.02, 0.01, 0.3) == pytest.approx(0.3 * math.exp(-2.0))
    assert expert_reward(1e6, 0.01, 0.3) == 0.0
    assert expert_reward(0.0, 0.0, 0.3) == 0.0  # sigma 0 is none
    assert curiosity_reward(0.2, 0.5) == pytest.approx(0.3)  # of a falling change
    assert curiosity_reward(0.5, 0.2) == pytest.approx(-0.3)


def test_beta_is_the_papers_unless_set() -> None:
    assert LearnerConfig(nu=0.05).reward_beta(3) == pytest.approx(0.05 * math.log(2) / 4)
    assert LearnerConfig(nu=0.05).reward_beta(1) == pytest.approx(0.05 * math.log(2) / 2)
    assert LearnerConfig(beta=0.0).reward_beta(3) == 0.0


@given(histories())
def test_the_mean_reward_is_the_papers_recursion(
    history: tuple[int, list[tuple[int, int, int, float]]],
) -> None:
    """R <- R~/t + (1 - 1/t) R, literally, against sums divided by t."""
    n, rewards = history
    stay, switch, dense = np.zeros(n), np.zeros(n), np.zeros((n, 2, n))
    R = np.zeros((n, 2, n))
    for t, (s, a, s_next, r) in enumerate(rewards, start=1):
        instantaneous = np.zeros((n, 2, n))
        instantaneous[s, a, s_next] = r
        R = instantaneous / t + (1 - 1 / t) * R
        add_reward(stay, switch, dense, s, a, s_next, r)
        np.testing.assert_allclose(dense / t, R, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(stay / t, R[:, 0].sum(1), rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(switch / t, R[:, 1].sum(1), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("n", [2, 3, 7])
def test_a_switch_is_uniform_over_the_others(n: int) -> None:
    draws = (np.arange(6 * (n - 1) * 100) + 0.5) / (6 * (n - 1) * 100)
    for stream in range(n):
        hits = np.bincount([other_stream(stream, n, d) for d in draws], minlength=n)
        assert hits[stream] == 0
        assert set(np.delete(hits, stream)) == {600}
