"""Policy iteration in O(n) against the dense linear solution."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from kernel_agent import STAY, KernelAgent

from cdmisfa.agents.agent import NOVEL
from cdmisfa.core.config import LearnerConfig

ACTIONS = 2


def transitions(n: int) -> np.ndarray:
    """P(s, a, s'): stay leads to s, switch to each other stream with 1/(n-1)."""
    P = np.zeros((n, ACTIONS, n))
    P[:, 0] = np.eye(n)
    P[:, 1] = (1 - np.eye(n)) / (n - 1)
    return P


def dense_values(r: np.ndarray, policy: np.ndarray, gamma: float) -> np.ndarray:
    """V of a policy: (1 - gamma P_pi) V = r_pi, (n,)."""
    n = len(policy)
    pick = np.arange(n)
    P = transitions(n)[pick, policy]
    return np.linalg.solve(np.eye(n) - gamma * P, r[pick, policy])


def dense_q(r: np.ndarray, policy: np.ndarray, gamma: float) -> np.ndarray:
    """Q of a policy, (n, 2)."""
    V = dense_values(r, policy, gamma)
    return r + gamma * transitions(len(policy)) @ V


def solve(
    stay: np.ndarray, switch: np.ndarray, count: int, gamma: float, start: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Policy and Q after a reward of 0 that makes so many of them, (n,) and (n, 2)."""
    known = KernelAgent(LearnerConfig(gamma=gamma, sigma=0.0, warm_up=0), len(stay))
    known.agent.stay_sum[:], known.agent.switch_sum[:] = stay, switch
    known.agent.policy[:] = 0 if start is None else start
    memory = known.agent.memory
    memory["rewards"], memory["novel_blocks"], memory["last_stream"] = count - 1, 1, 0
    memory["xi"] = 0.5
    assert known.think(0.5, NOVEL, STAY, np.zeros((100, 1)))["reward"] == 0.0
    return known.agent.policy, known.values()


@st.composite
def problems(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, int, float, np.ndarray]:
    n = draw(st.integers(2, 50))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    scale = 10.0 ** draw(st.integers(-5, 1))
    gamma = draw(st.sampled_from([0.0, 0.5, 0.9, 0.99, 0.999]))
    start = rng.integers(0, 2, n)
    count = draw(st.integers(1, 2000))
    return scale * rng.standard_normal(n), scale * rng.standard_normal(n), count, gamma, start


@settings(deadline=None)
@given(problems())
def test_q_is_the_dense_solution_and_the_policy_is_optimal(
    problem: tuple[np.ndarray, np.ndarray, int, float, np.ndarray],
) -> None:
    stay, switch, count, gamma, start = problem
    n = len(stay)
    policy, Q = solve(stay, switch, count, gamma, start)
    r = np.stack([stay, switch / (n - 1)], axis=1) / count
    expected = dense_q(r, policy, gamma)
    np.testing.assert_allclose(Q, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    slack = 1e-9 * np.abs(expected).max()
    assert (expected[np.arange(n), policy] >= expected.max(axis=1) - slack).all()


def lstd_q(
    samples: list[tuple[int, int, float, int]], policy: np.ndarray, gamma: float
) -> np.ndarray:
    """LSTD-Q (Lagoudakis and Parr 2003) with an indicator feature of each pair (s, a), (n, 2)."""
    features = np.eye(ACTIONS * len(policy)).reshape(len(policy), ACTIONS, -1)
    A, b = np.zeros((ACTIONS * len(policy),) * 2), np.zeros(ACTIONS * len(policy))
    for s, a, reward, to in samples:
        A += np.outer(features[s, a], features[s, a] - gamma * features[to, policy[to]])
        b += features[s, a] * reward
    return np.linalg.solve(A, b).reshape(-1, ACTIONS)


@settings(deadline=None)
@given(st.integers(2, 7), st.sampled_from([0.5, 0.9, 0.99]), st.integers(0, 2**32 - 1))
def test_policy_iteration_is_lspi_with_indicator_features(n: int, gamma: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    R = rng.standard_normal((n, ACTIONS, n))
    ways = [(s, int(s != to), to) for s in range(n) for to in range(n)]
    times = {(s, a): rng.integers(1, 4) for s in range(n) for a in range(ACTIONS)}
    samples = [(s, a, R[s, a, to], to) for s, a, to in ways for _ in range(times[s, a])]
    stay, switch = np.diagonal(R[:, 0]).copy(), R[:, 1].sum(axis=1) - np.diagonal(R[:, 1])
    start = rng.integers(0, 2, n)
    policy, Q = solve(stay, switch, 1, gamma, start)
    expected = lstd_q(samples, policy, gamma)
    np.testing.assert_allclose(Q, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    for _ in range(20):
        start = lstd_q(samples, start, gamma).argmax(axis=1)
    assert policy.tolist() == start.tolist()


@pytest.mark.parametrize("n", [2, 3, 7, 50])
@pytest.mark.parametrize("reward", [0.0, 0.1, -0.1, 1 / 3, 1e-7])
@pytest.mark.parametrize("gamma", [0.5, 0.9, 0.99, 0.999])
def test_ties_go_to_stay_whatever_the_rounding(n: int, reward: float, gamma: float) -> None:
    stay = np.full(n, reward)
    for start in (np.zeros(n, np.int64), np.ones(n, np.int64)):
        policy, _ = solve(stay, stay * (n - 1), 7, gamma, start)
        assert policy.tolist() == [0] * n


@pytest.mark.parametrize(("best", "policy"), [(0, [0, 1, 1]), (1, [1, 0, 1]), (2, [1, 1, 0])])
def test_the_papers_policies(best: int, policy: list[int]) -> None:
    stay = np.full(3, 0.01)
    stay[best] = 0.05
    assert solve(stay, np.zeros(3), 10, 0.99)[0].tolist() == policy
