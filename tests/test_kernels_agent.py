"""The agent's kernels against the plain reference, and against themselves."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from both_modules import assert_same_bits, both_modules
from hypothesis import given, settings
from hypothesis import strategies as st
from kernel_agent import KernelAgent
from reference import agent as reference

from cdmisfa import kernels
from cdmisfa.agents.agent import CONSTANT, MEMORY, NOVEL, Agent, Frozen
from cdmisfa.agents.learner import CuriousLearner
from cdmisfa.core.blocks import PIXEL, Block, SourceSpec, freeze
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.errors import UsageError
from cdmisfa.core.expansion import expand
from cdmisfa.core.signals import SignalsHash
from recorder.world.oscillatory import OscillatorySource

EXACT = {"stream", "module", "novel", "known_by", "saved", "novel_blocks", "explored", "action"}
EXACT |= {"next_stream", "share", "epsilon"}
"""What is the same to the last bit."""


def copied(agent: Agent) -> Agent:
    return Agent(*(array.copy() for array in agent))


def assert_signals(actual: dict[str, Any], expected: dict[str, Any]) -> None:
    assert {k: actual[k] for k in EXACT} == {k: expected[k] for k in EXACT}
    for name in actual.keys() - EXACT:
        np.testing.assert_allclose(actual[name], expected[name], 1e-9, 1e-12, err_msg=name)


def assert_like(actual: Agent, expected: Agent) -> None:
    for name, one, two in zip(Agent._fields[1:], actual[1:], expected[1:], strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-9, atol=1e-12, err_msg=name)
    for name in MEMORY.names or ():
        np.testing.assert_allclose(actual.memory[name], expected.memory[name], 1e-9, 1e-12, name)


@st.composite
def agents(draw: st.DrawFn) -> tuple[KernelAgent, np.random.Generator]:
    algorithm = draw(st.sampled_from(["2.0", "1.0"]))
    config = LearnerConfig(
        algorithm=algorithm,
        components=3,
        outputs=draw(st.integers(1, 3)),
        tau=draw(st.integers(3, 30)),
        warm_up=draw(st.integers(0, 3)),
        gamma=draw(st.sampled_from([0.0, 0.9, 0.99])),
        sigma=draw(st.sampled_from([0.0, 0.01])),
        delta=draw(st.sampled_from([1e-4, 1.0])),
        eta_dot_window=draw(st.integers(1, 10)),
        epsilon_start=draw(st.sampled_from([1.2, 0.5, 1e-3])),
        novel_share=draw(st.sampled_from([0.0, 0.9])),
        roc_centres=draw(st.integers(1, 3)),
        roc_error=draw(st.sampled_from([0.1, 2.0])),
        roc_radius=draw(st.sampled_from([0.1, 1.0])),
        roc_memory=draw(st.integers(1, 10)),
    )
    n = draw(st.integers(1, 300 if algorithm == "2.0" else 64))
    return KernelAgent(config, n), np.random.default_rng(draw(st.integers(0, 2**32 - 1)))


@settings(max_examples=40)
@given(agents(), st.sampled_from([1e-3, 1.0, 1e3]), st.booleans())
def test_an_agent_thinks_as_the_reference_does(
    case: tuple[KernelAgent, np.random.Generator], scale: float, still: bool
) -> None:
    known, rng = case
    shape = known.config.tau, known.config.outputs
    for k in range(20):
        y = scale * rng.standard_normal(shape).cumsum(axis=0)
        if still and k % 3 == 0 and known.memory["novel_blocks"]:
            y[:, 0] = scale
        xi = np.where(rng.random(len(y)) < 0.1, np.nan, rng.random(len(y)) * 0.02)
        known_by, draws = int(rng.choice([NOVEL, NOVEL, NOVEL, 1, CONSTANT])), rng.random(3)
        expected, t = copied(known.agent), known.t
        expected_signals = reference.think(expected, known.rules, known_by, xi, y, t, draws)
        assert_signals(known.think(xi, known_by, tuple(draws), y), expected_signals)
        assert_like(known.agent, expected)
        memory = known.memory["scale"]
        Q = reference.action_values(
            expected.stay_sum, expected.switch_sum, memory, known.rules.gamma, expected.policy
        )
        np.testing.assert_allclose(known.values(), Q, rtol=1e-9, atol=1e-9 * abs(Q).max(initial=0))


SPECIAL = [0.0, -0.0, 5e-324, -1e-310, 1e-160, 1e160, 1e308, np.inf, -np.inf, np.nan]


@settings(max_examples=60)
@given(agents(), st.lists(st.sampled_from(SPECIAL), min_size=1, max_size=8))
def test_whatever_the_numbers_it_goes_on(
    case: tuple[KernelAgent, np.random.Generator], special: list[float]
) -> None:
    known, rng = case
    shape = known.config.tau, known.config.outputs
    for _ in range(15):
        y = np.where(rng.random(shape) < 0.3, rng.choice(special, shape), rng.random(shape))
        xi = np.where(rng.random(len(y)) < 0.5, rng.choice(special, len(y)), rng.random(len(y)))
        signals = known.think(xi, NOVEL, tuple(rng.random(3)), y)
        assert 0 <= signals["next_stream"] < len(known.agent.policy)
        assert set(known.agent.policy) <= {0, 1}


@settings(max_examples=60)
@given(agents(), st.integers(0, 4), st.booleans(), st.booleans())
def test_it_recognises_what_the_reference_does(
    case: tuple[KernelAgent, np.random.Generator], M: int, pixels: bool, still: bool
) -> None:
    known, rng = case
    (n, J), size = (known.config.tau, known.config.outputs), 7
    shown = rng.integers(0, 256, (n, size)).astype(np.uint8) if pixels else rng.random((n, size))
    if still:
        shown[:] = shown[0]
    phi, offset = rng.standard_normal((M * J, size)), rng.random(M * J)
    x = shown * PIXEL if pixels else shown
    y = (x @ phi.T - offset).reshape(n, M, J).transpose(1, 0, 2)
    centres = rng.standard_normal((M, *known.agent.centres.shape))
    counts = rng.integers(0, 2, (M, *known.agent.counts.shape)).astype(float)
    if known.rules.tabular:
        centres[M // 2 :, :, 0] = y[M // 2 :, None] + 0.01
    band = np.full((M, J), 1e-3)
    mean = reference.verdict(y, band, band)[1]
    mean[: M // 2] += 0.01
    frozen = Frozen(phi, offset, mean, band, centres, counts)
    expected = reference.recognise(known.agent, known.rules, frozen, shown, x, PIXEL)
    result = known.recognise(frozen, shown, shown)
    assert result[0] == expected[0]
    for one, two in zip(result[1:], expected[1:], strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("algorithm", "outputs"), [("2.0", 1), ("2.0", 3), ("1.0", 1)])
def test_a_learner_is_the_reference_step_by_step(algorithm: str, outputs: int) -> None:
    config = LearnerConfig(
        algorithm=algorithm, outputs=outputs, epsilon_decay=0.99, delta=0.004, roc_error=0.3, tau=50
    )
    source = OscillatorySource()
    learner = CuriousLearner(config, source.spec, 5)
    copy = CuriousLearner(config, source.spec, 5)  # draws and learns what the reference is told
    for _ in range(500):
        copy.restore(learner.state)
        block = source.take(learner.stream, learner.tau)
        frames, x = block.frames, expand(config.expansion, block.frames)
        draws, agent, feature = copy.policy_rng.random(3), copy.agent, copy.abstraction
        gate = reference.recognise(agent, copy.rules, copy.frozen, frames, x, 1.0)
        y, xi = np.full((config.tau, outputs), np.nan), np.zeros(0)
        if gate[0] == NOVEL:
            gap = reference.has_gap(agent.memory, block.stream, block.t)
            xi = feature.update(x, gap)
            y = (x - feature.mean) @ feature.phi.T
        expected_signals = reference.think(agent, copy.rules, gate[0], xi, y, block.t, draws)
        before = len(learner.modules)
        signals = learner.step(block)
        assert_signals(
            {name: getattr(signals, name) for name in expected_signals}, expected_signals
        )
        for result, expected in zip(
            (signals.y_frozen, signals.eta_inst_frozen, signals.roc_error_frozen, signals.y),
            (*gate[1:], y),
            strict=True,
        ):
            np.testing.assert_allclose(result, expected, rtol=1e-7, atol=1e-9)
        if len(learner.modules) == before:
            assert_like(learner.agent, agent)
    assert learner.modules, "nothing was learned: the comparison would not cover the gate"


def digest(config: LearnerConfig, spec: SourceSpec, frames: np.ndarray | None = None) -> str:
    """Of 300 iterations; on oscillatory streams, or on blocks of frames."""
    learner, signals, source = CuriousLearner(config, spec, 3), SignalsHash(), OscillatorySource()
    for k in range(300):
        block = source.take(learner.stream, config.tau)
        if frames is not None:
            block = Block(learner.stream, block.t, frames[k % len(frames)], block.truth[:, :0])
        signals.add(learner.step(block))
    return signals.hexdigest()


@pytest.mark.parametrize(
    "config",
    [
        LearnerConfig(delta=0.01),
        LearnerConfig(algorithm="1.0", roc_error=0.5),
        LearnerConfig(expansion="none", tau=17, outputs=3, components=4, delta=1.0),
    ],
)
def test_learners_have_the_same_bits_on_every_processor(config: LearnerConfig) -> None:
    spec, frames = OscillatorySource().spec, None
    if config.expansion == "none":
        rng = np.random.default_rng(0)
        frames = freeze(rng.integers(0, 256, (5, config.tau, 3, 7), dtype=np.uint8))
        spec = SourceSpec(spec.streams, (3, 7), "uint8")
    result = []
    for module in both_modules():
        with module:
            result.append(digest(config, spec, frames))
    assert result[0] == result[1]


def test_many_streams_and_special_numbers_have_the_same_bits_on_every_processor() -> None:
    result = []
    for module in both_modules():
        with module:
            known, rng = (
                KernelAgent(LearnerConfig(tau=20, warm_up=0), 300),
                np.random.default_rng(0),
            )
            for k in range(200):
                y = rng.standard_normal((20, 1))
                y[rng.integers(0, 20)] = SPECIAL[k % len(SPECIAL)] if k > 150 else 0.5
                known.think(rng.random(20), NOVEL, tuple(rng.random(3)), y)
                if k == 150:
                    finite = known.values(), *copied(known.agent)[1:]
            result.append((*finite, known.values(), *known.agent[1:]))
    assert_same_bits(*result)


DAMAGES = [("stream", -1), ("stream", 3), ("stream", 2**62), ("last_stream", -2)]
DAMAGES += [("last_stream", 3), ("last_action", -1), ("last_action", 2), ("rewards", -1)]
DAMAGES += [("novel_blocks", 2**63 - 1), ("iteration", 2**63 - 1), ("idle", -(2**63))]
DAMAGES += [("module", 2**63 - 1)]


@pytest.mark.parametrize(("name", "value"), DAMAGES)
def test_an_index_that_points_nowhere_is_refused(name: str, value: int) -> None:
    known = KernelAgent(LearnerConfig(tau=5), 3)
    known.agent.memory[name] = value
    before = copied(known.agent)
    y, none = np.zeros((5, 1)), np.empty((0, 1))
    frozen = Frozen(none, none[:, 0], none, none, np.zeros((0, 0, 0, 5, 1)), np.zeros((0, 0, 0)))
    for attempt in (
        lambda: known.think(0.1, NOVEL, (0.0, 0.0, 0.0), y),
        lambda: known.recognise(frozen, y, y),
    ):
        with pytest.raises(UsageError, match="has a damaged state"):
            attempt()
        assert [array.tobytes() for array in known.agent] == [a.tobytes() for a in before]


def test_a_learner_with_a_damaged_memory_refuses_to_go_on() -> None:
    source = OscillatorySource()
    learner = CuriousLearner(LearnerConfig(), source.spec, 0)
    state = learner.state
    state.arrays["agent.memory"]["last_stream"] = 7
    learner.restore(state)
    with pytest.raises(UsageError, match="the learner has a damaged state"):
        learner.step(source.take(learner.stream, learner.tau))
    x = kernels.frames_of(np.zeros((3 * 600, 5)))
    with pytest.raises(UsageError, match="the learner has a damaged state"):
        learner.repeat(x, x, np.zeros((4, 3)))


def test_what_does_not_fit_is_refused() -> None:
    source = OscillatorySource()
    learner = CuriousLearner(LearnerConfig(), source.spec, 0)
    one, two = (kernels.frames_of(np.zeros((n, 5))) for n in (1800, 1801))
    with pytest.raises(UsageError, match="frames is"):
        learner.repeat(one, two, np.zeros((4, 3)))
