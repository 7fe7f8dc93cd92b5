"""The agent's iteration: what is rewarded, what is saved, what is forgotten."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from kernel_agent import STAY, KernelAgent
from reference.agent import ready_to_save

from cdmisfa.agents.agent import CONSTANT, NOVEL, Agent, begin_abstraction, new_agent
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.signals import DENSE_STREAMS

TAU = 50
SLOW = np.sin(2 * np.pi * np.arange(5000) / 250)


def config(**values: Any) -> LearnerConfig:
    return LearnerConfig(**{"warm_up": 2, **values})


class Bench(KernelAgent):
    """An agent that is told what its gate and its abstraction say, of a slow output by default."""

    def __init__(self, n: int = 3, first: int = 0, **values: Any) -> None:
        super().__init__(config(**{"tau": TAU, **values}), n, first)

    def step(
        self,
        xi: Any = 0.01,
        known_by: int = NOVEL,
        draws: tuple[float, float, float] = STAY,
        y: np.ndarray | None = None,
    ) -> dict[str, Any]:
        start = self.t % 4000
        return self.think(xi, known_by, draws, SLOW[start : start + TAU, None] if y is None else y)

    @property
    def variance(self) -> float:
        return float((self.agent.recent_square - self.agent.recent_mean**2)[0])


def test_rewards_begin_after_the_warm_up() -> None:
    bench = Bench(warm_up=2)
    outs = [bench.step(xi) for xi in (0.5, 0.3, 0.2, 0.1)]
    assert math.isnan(outs[0]["xi_dot"])
    assert outs[1]["xi_dot"] == pytest.approx(-0.2)
    assert [math.isnan(o["reward"]) for o in outs] == [True, True, False, False]
    assert bench.memory["rewards"] == 2


def test_the_reward_goes_to_the_transition_that_led_to_the_block() -> None:
    bench = Bench(warm_up=1, sigma=0.01, beta=0.5)
    bench.step(0.5, draws=(0.0, 0.9, 0.0))  # switch from 0 to 1
    out = bench.step(0.02, draws=(0.0, 0.0, 0.0))
    expected = 0.48 + 0.5 * math.exp(-2.0)
    assert out["curiosity"] == pytest.approx(0.48)
    assert out["expert"] == pytest.approx(0.5 * math.exp(-2.0))
    assert out["reward"] == pytest.approx(expected)
    assert bench.agent.dense[0, 1, 1] == pytest.approx(expected)
    assert np.count_nonzero(bench.agent.dense) == 1
    assert bench.agent.switch_sum.tolist() == pytest.approx([expected, 0, 0])
    assert (out["stream"], out["next_stream"]) == (1, 1)


@pytest.mark.parametrize("verdict", [1, 2, CONSTANT])
def test_a_known_block_teaches_nothing_but_time_goes_on(verdict: int) -> None:
    bench = Bench(warm_up=0)
    for xi in (0.5, 0.4, 0.3):
        bench.step(xi)
    before = {name: a.copy() for name, a in bench.agent._asdict().items() if name != "memory"}
    memory = bench.memory
    out = bench.step(0.1, known_by=verdict, y=np.full((TAU, 1), np.nan))
    for name, array in before.items():
        np.testing.assert_array_equal(getattr(bench.agent, name), array, err_msg=name)
    assert out["known_by"] == verdict
    assert not out["novel"]
    assert all(math.isnan(out[k]) for k in ("xi", "xi_dot", "curiosity", "expert", "reward"))
    for name in ("rewards", "novel_blocks", "xi", "fed_stream", "fed_until"):
        assert bench.memory[name] == memory[name], name
    assert out["epsilon"] == memory["epsilon"] * 0.999
    assert out["share"] == pytest.approx(memory["share"] * (1 - 2 / 41))
    assert bench.memory["iteration"] == memory["iteration"] + 1


def test_only_novel_blocks_of_the_stream_of_the_block_before_count_as_staying() -> None:
    bench = Bench()
    start = (0.0, 0.9, 0.0)  # to the other stream after the block
    shares = [bench.step(draws=draws)["share"] for draws in (STAY, start, STAY, STAY)]
    retained = 1 - 2 / 41
    assert shares[0] == pytest.approx(retained)  # nothing came before
    assert shares[1] == pytest.approx(1 - (1 - shares[0]) * retained)
    assert shares[2] == pytest.approx(shares[1] * retained)
    assert shares[3] == pytest.approx(1 - (1 - shares[2]) * retained)


def test_eta_dot_is_the_running_mean_change_of_eta() -> None:
    bench, seen, expected = Bench(), [], math.nan
    rng = np.random.default_rng(1)
    for _ in range(30):
        bench.step(y=rng.standard_normal((TAU, 1)))
        seen.append(bench.agent.eta[0])
        if len(seen) > 1:
            change = abs(seen[-1] - seen[-2])
            known = len(seen) > 2
            expected = expected + 2 / 41 * (change - expected) if known else change
        np.testing.assert_allclose(bench.agent.eta_dot[0], expected, rtol=1e-12)


def test_the_gates_band_is_the_mean_and_sd_of_eta_inst() -> None:
    bench, seen = Bench(gate_window=20), []
    rng = np.random.default_rng(2)
    for _ in range(10):  # up to half the window the rate is 1/n: the plain mean and SD
        bench.step(y=rng.standard_normal((TAU, 1)))
        seen.append(bench.agent.eta_inst[0])
        assert bench.agent.gate_mean[0] == pytest.approx(np.mean(seen))
        assert math.sqrt(bench.agent.gate_variance[0]) == pytest.approx(np.std(seen), abs=1e-12)


def test_a_block_longer_than_the_window_counts_fully_and_not_more() -> None:
    bench = Bench(slowness_window=10)
    rng = np.random.default_rng(3)
    for _ in range(20):
        y = rng.standard_normal((TAU, 1)) * rng.choice([0.1, 10.0])
        bench.step(y=y)
        assert bench.agent.derivative[0] == pytest.approx(np.mean(np.diff(y[:, 0]) ** 2))
        assert bench.variance == pytest.approx(np.var(y))


def saving(bench: Bench, limit: int = 2000, **step: Any) -> int:
    """Steps until the abstraction is saved, or 0."""
    for k in range(1, limit):
        if bench.step(**step)["saved"]:
            return k
    return 0


def test_a_settled_output_is_saved_after_more_blocks_than_the_window() -> None:
    assert saving(Bench(delta=1.0, eta_dot_window=40)) == 41
    assert saving(Bench(delta=1.0, eta_dot_window=7)) == 8
    assert saving(Bench(delta=1e-30), limit=200) == 0


def test_a_dead_output_is_not_saved() -> None:
    bench = Bench(delta=1.0, tau=250)
    tiny = 0.3 * SLOW[:250, None]  # variance .045, below .1
    assert saving(bench, limit=100, y=tiny) == 0
    assert not ready_to_save(bench.agent, bench.rules)


def test_a_hardly_fed_abstraction_is_not_saved() -> None:
    bench = Bench(delta=1.0)
    for k in range(600):
        assert not bench.step(known_by=NOVEL if k % 4 else 1)["saved"]
    assert bench.memory["novel_blocks"] == 450
    assert 0 < saving(bench) < 60


def test_after_a_save_everything_starts_anew() -> None:
    bench = Bench(delta=1.0, warm_up=0)
    steps = saving(bench)
    saved = bench.memory
    assert saved["epsilon"] == 1.2
    assert bench.values().any()
    begin_abstraction(bench.agent, bench.config.epsilon_start)
    fresh = new_agent(bench.config, 3, 0)
    for name in Agent._fields[1:]:
        np.testing.assert_array_equal(getattr(bench.agent, name), getattr(fresh, name), name)
    memory, first = bench.memory, fresh.memory[0]
    unchanged = {"iteration": steps, "module": 2, "last_action": 0, "last_stream": 0}
    for name in fresh.memory.dtype.names:
        np.testing.assert_array_equal(memory[name], unchanged.get(name, first[name]), name)


@given(st.integers(1, 8), st.lists(st.tuples(st.floats(0, 1), *[st.floats(0, 0.99)] * 3)))
def test_the_next_stream_follows_from_the_action(
    n: int, history: list[tuple[float, float, float, float]]
) -> None:
    bench = Bench(n, warm_up=0)
    stream = 0
    for xi, *draws in history:
        out = bench.step(xi, draws=(draws[0], draws[1], draws[2]))
        assert out["stream"] == stream
        stream = out["next_stream"]
        assert bench.memory["stream"] == stream
        assert (stream == out["stream"]) == (out["action"] == 0 or n == 1)
        assert np.isfinite(bench.values()).all()


def test_ten_thousand_streams_need_memory_in_proportion() -> None:
    def size(n: int) -> int:
        return sum(array.nbytes for array in new_agent(config(), n, 0))

    assert new_agent(config(), DENSE_STREAMS, 0).dense.shape == (64, 2, 64)
    assert new_agent(config(), DENSE_STREAMS + 1, 0).dense.shape == (0, 2, 0)
    assert size(10_000) - size(5_000) <= 5_000 * 64
    rng = np.random.default_rng(4)
    bench = Bench(10_000, warm_up=0)
    visited = set()
    for xi in rng.random(300):
        out = bench.step(xi, draws=tuple(rng.random(3)))
        visited.add(out["next_stream"])
    assert len(visited) > 100
    assert np.isfinite(bench.values()).all()
    assert bench.values().any()
