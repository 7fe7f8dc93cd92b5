"""The learner: the oscillatory experiment, determinism, and what a block may do to it."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from cdmisfa.agents.agent import CONSTANT
from cdmisfa.agents.learner import CuriousLearner
from cdmisfa.core.blocks import Block, SourceSpec, freeze
from cdmisfa.core.config import LearnerConfig, build, load_preset
from cdmisfa.core.errors import CdmisfaError, UsageError
from cdmisfa.core.expansion import expand
from cdmisfa.core.learning import overwrite
from cdmisfa.core.signals import SIGNALS, BlockSignals, SignalsHash
from recorder.world.oscillatory import OscillatorySource

CONFIG = build(LearnerConfig, "learner", load_preset("oscillatory")["learner"])


@dataclass
class Trial:
    learner: CuriousLearner
    signals: list[BlockSignals]
    sha256: str


def trial(
    seed: int,
    iterations: int = 5000,
    modules: int = 3,
    config: LearnerConfig = CONFIG,
    source: OscillatorySource | None = None,
) -> Trial:
    source = source or OscillatorySource()
    learner = CuriousLearner(config, source.spec, seed)
    digest, signals = SignalsHash(), []
    while len(learner.modules) < modules and learner.iteration < iterations:
        signals.append(learner.step(source.take(learner.stream, learner.tau)))
        digest.add(signals[-1])
    return Trial(learner, signals, digest.hexdigest())


@pytest.fixture(scope="module")
def whole() -> Trial:
    return trial(0)


@pytest.mark.parametrize("seed", [11, 12, 13, 14, 15])
def test_the_oscillatory_experiment(seed: int) -> None:
    learner = trial(seed).learner
    assert [m.stream_index for m in learner.modules] == [0, 1, 2]
    assert [m.policy.tolist() for m in learner.modules] == [[0, 1, 1], [1, 0, 1], [1, 1, 0]]
    for module, eta in zip(learner.modules, (0.008, 0.006, 0.004), strict=True):
        assert 0.6 * eta < module.eta[0] < 1.3 * eta  # Var(y) remembers the search
    assert 1000 < learner.iteration < 2500


def test_modules_encode_the_slow_features_of_their_streams(whole: Trial) -> None:
    theta = 2 * np.pi * np.arange(500) / 500
    slow = [np.sin(4 * theta - np.pi / 4), np.sin(3 * theta), np.cos(2 * theta)]
    for module, expected in zip(whole.learner.modules, slow, strict=True):
        source = OscillatorySource()
        x = source.take(module.stream_index, 500).frames
        i, j = np.triu_indices(2)
        expanded = np.concatenate([x, x[:, i] * x[:, j]], axis=1)
        y = (expanded - module.mean) @ module.phi[0]
        np.testing.assert_allclose(module.transform(x)[:, 0], y, rtol=1e-9, atol=1e-9)
        assert abs(np.corrcoef(y, expected)[0, 1]) > 0.99


def test_signals_have_the_documented_shapes(whole: Trial) -> None:
    config, n = whole.learner.config, 3
    modules = 0
    for k, record in enumerate(whole.signals):
        sizes = {"T": config.tau, "J": config.outputs, "M": modules, "S": n, "A": 2}
        for signal in SIGNALS.values():
            value = np.asarray(getattr(record, signal.name))
            assert value.shape == tuple(sizes[d] for d in signal.dims), (k, signal.name)
        assert (record.iteration, record.t) == (k, k * config.tau)
        assert record.log_time == whole.learner.spec.time_ns(record.t)
        assert record.module == modules + 1
        modules += record.saved
    assert modules == 3


def test_r_is_the_mean_of_the_rewards_since_the_last_module(whole: Trial) -> None:
    total, count, last = np.zeros((3, 2, 3)), 0, None
    for record in whole.signals:
        if not np.isnan(record.reward) and not record.saved:
            total[last.stream, last.action, record.stream] += record.reward
            count += 1
        np.testing.assert_allclose(record.R, total / max(count, 1), rtol=1e-9, atol=1e-18)
        if record.saved:
            total, count = np.zeros((3, 2, 3)), 0
        last = record


def test_after_a_save_everything_begins_anew(whole: Trial) -> None:
    saves = [k for k, record in enumerate(whole.signals) if record.saved]
    for k in saves[:-1]:
        saved, after = whole.signals[k], whole.signals[k + 1]
        assert saved.novel
        assert saved.epsilon == CONFIG.epsilon_start
        assert after.epsilon == CONFIG.epsilon_start * CONFIG.epsilon_decay
        assert not after.R.any()
        assert not after.Q.any()
        assert not after.policy.any()
        assert after.novel_blocks == int(after.novel)
        stayed = after.novel and after.stream == saved.stream
        assert after.share == pytest.approx(1.0 if stayed else 1 - 2 / 41)


def test_a_saved_module_is_what_the_signals_said(whole: Trial) -> None:
    saves = [record for record in whole.signals if record.saved]
    for module, record in zip(whole.learner.modules, saves, strict=True):
        assert (module.iteration, module.stream_index) == (record.iteration, record.stream)
        assert (record.eta_dot < CONFIG.delta).all()
        assert (record.variance >= CONFIG.min_variance).all()
        assert record.share >= CONFIG.novel_share
        for name in ("eta", "policy"):
            np.testing.assert_array_equal(getattr(module, name), getattr(record, name))
        np.testing.assert_array_equal(module.band_mean, record.gate_mean)
        np.testing.assert_array_equal(module.band_sd, record.gate_sd)


def snapshot(module: Any) -> dict[str, Any]:
    return {f.name: np.array(getattr(module, f.name)) for f in dataclasses.fields(module)}


def test_a_module_never_changes_once_frozen() -> None:
    source = OscillatorySource()
    learner = CuriousLearner(CONFIG, source.spec, 0)
    while not learner.modules:
        learner.step(source.take(learner.stream, learner.tau))
    frozen = snapshot(learner.modules[0])
    for _ in range(60):
        learner.step(source.take(learner.stream, learner.tau))
    for name, value in snapshot(learner.modules[0]).items():
        np.testing.assert_array_equal(value, frozen[name], err_msg=name)
    state = [*learner.agent, *learner.abstraction.state]
    for field in dataclasses.fields(learner.modules[0]):
        value = getattr(learner.modules[0], field.name)
        if isinstance(value, np.ndarray) and value.size:
            assert not any(np.shares_memory(value, array) for array in state), field.name


def test_nobody_can_reach_the_learner_through_what_it_gave_away() -> None:
    def vandal(record: BlockSignals, learner: CuriousLearner) -> None:
        for name in SIGNALS:
            value = np.asarray(getattr(record, name))
            if value.ndim and value.flags.writeable:
                value[...] = 0
        learner.phi[...] = 7
        learner.policy[...] = 1

    hashes = []
    for touch in (lambda record, learner: None, vandal):
        source, digest = OscillatorySource(), SignalsHash()
        learner = CuriousLearner(CONFIG, source.spec, 0)
        for _ in range(700):
            record = learner.step(source.take(learner.stream, learner.tau))
            digest.add(record)
            touch(record, learner)
        assert learner.modules
        hashes.append(digest.hexdigest())
    assert hashes[0] == hashes[1]


SPEC = OscillatorySource().spec
FRAMES = freeze(np.random.default_rng(0).standard_normal((100, 2)))


def block(stream: int = 0, t: int = 0, frames: np.ndarray = FRAMES) -> Block:
    return Block(stream, t, frames, np.empty((len(frames), 0)))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda s: block((s + 1) % 3), "not 100 frames of stream"),
        (lambda s: block(s, frames=FRAMES[:99]), "not 99 frames of stream"),
        (lambda s: block(s, frames=np.zeros((100, 3))), r"not 100 frames .* \(3,\) float64"),
        (lambda s: block(s, frames=np.zeros((100, 2), np.float32)), r"\(2,\) float32"),
    ],
)
def test_a_block_that_was_not_asked_for_is_refused(
    change: Callable[[int], Block], words: str
) -> None:
    learner = CuriousLearner(CONFIG, SPEC, 0)
    expected = trial(0, iterations=1).sha256
    with pytest.raises(ValueError, match=words):
        learner.step(change(learner.stream))
    assert learner.iteration == 0
    digest = SignalsHash()
    digest.add(learner.step(OscillatorySource().take(learner.stream, 100)))
    assert digest.hexdigest() == expected, "a refused block left a trace"


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        *((value, "not finite") for value in (np.nan, np.inf, -np.inf)),
        (-1e160, r"larger than 1e\+100"),  # its products overflow
    ],
)
def test_values_that_spoil_every_estimate_are_refused_with_the_place(
    bad: float, words: str
) -> None:
    learner = CuriousLearner(CONFIG, SPEC, 0)
    frames = FRAMES.copy()
    frames[40, 1] = bad
    with pytest.raises(CdmisfaError, match=rf"stream x\d .*{words} in frames 300 to 399"):
        learner.step(block(learner.stream, 300, frames))
    assert learner.iteration == 0


def test_a_constant_block_carries_nothing() -> None:
    source = OscillatorySource(("zero", "zero"))
    learner = CuriousLearner(CONFIG, source.spec, 0)
    for _ in range(30):
        record = learner.step(source.take(learner.stream, learner.tau))
        assert (record.known_by, record.novel) == (CONSTANT, False)
        assert np.isnan(record.reward)
        assert not learner.phi.any()


def test_derivatives_never_reach_across_a_gap() -> None:
    learner = CuriousLearner(CONFIG, SourceSpec(("only",), (2,), "float64"), 0)
    alone = copy.deepcopy(learner.abstraction)
    still = freeze(np.ones((100, 2)))
    rng = np.random.default_rng(1)
    frames = [freeze(rng.standard_normal((100, 2))) for _ in range(5)]
    blocks = [  # of the third nothing is learned, and before the last frames are missing
        *((0, frames[0], True), (100, frames[1], False), (200, still, None)),
        *((300, frames[2], True), (400, frames[3], False), (900, frames[4], True)),
    ]
    for t, shown, gap in blocks:
        assert learner.step(block(0, t, shown)).novel == (gap is not None)
        if gap is not None:
            alone.update(expand(CONFIG.expansion, shown), gap)
        assert learner.phi.tobytes() == alone.phi.tobytes()


@pytest.mark.parametrize(
    ("config", "shape", "words"),
    [
        (LearnerConfig(expansion="quadratic"), (48, 128), "learner.expansion quadratic makes 18,"),
        (LearnerConfig(components=6), (2,), "learner.components is 6, more than the 5 inputs: "),
    ],
)
def test_inputs_that_cannot_be_learned_are_refused(
    config: LearnerConfig, shape: tuple[int, ...], words: str
) -> None:
    with pytest.raises(UsageError, match=words):
        CuriousLearner(config, SourceSpec(("a", "b"), shape, "float64"), seed=0)


@pytest.mark.parametrize("second", [None, np.ones(3), np.ones(2, np.float32)])
def test_what_was_stored_is_taken_whole_or_not_at_all(second: np.ndarray | None) -> None:
    own = {"first": np.zeros(2), "second": np.zeros(2)}
    stored = {"first": np.ones(2)} | ({} if second is None else {"second": second})
    with pytest.raises(ValueError, match="second is missing or has a different shape or type"):
        overwrite(own, stored)
    assert not own["first"].any()
    overwrite(own, stored | {"second": np.ones(2), "another": np.ones(2)})
    assert own["first"].all()
    assert own["second"].all()
