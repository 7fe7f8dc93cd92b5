"""The progress learner: what is there is learned, what is not is given up, and it ends."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Cdmisfa
from hypothesis import given
from hypothesis import strategies as st
from moving_pictures import MovingPictures

from cdmisfa import Run
from cdmisfa.agents.progress import candidate as held
from cdmisfa.agents.progress.attention import ERROR_BLOCKS, RULES, Situation
from cdmisfa.agents.progress.candidate import WHITE_NOISE_SLOWNESS, Candidate, learning_error
from cdmisfa.agents.progress.config import ProgressConfig
from cdmisfa.agents.progress.decisions import (
    is_promising,
    monitor_output,
    new_streams,
    novelty,
    output_changed,
    rejection_reason,
    relative_fitted_slowness,
    relative_slowness,
    start_monitoring,
)
from cdmisfa.agents.progress.learner import ProgressLearner
from cdmisfa.core.blocks import Block, freeze
from cdmisfa.core.signals import canonical_bytes
from cdmisfa.experiments.loop import learn_blocks
from cdmisfa.experiments.session import run_session
from recorder.recording import record
from replay.open_sources import open_recording

CONFIG = ProgressConfig(components=8)


@pytest.mark.parametrize(
    ("power", "steps", "expected"),
    [
        ([1], [1], 0),
        ([10], [1], 1),
        ([0.1], [1], 1),
        ([1], [np.exp(1.6)], 1),
        ([100, 1], [1, 1], 1),
        ([10, 0.1], [1, 1], 1),
        ([1, 1], [np.exp(1.6), np.exp(-1.6)], 1),
    ],
)
def test_the_novelty_is_1_at_each_limit(
    power: list[float], steps: list[float], expected: float
) -> None:
    assert novelty(power, steps) == pytest.approx(expected)


@given(st.floats(-3, 3), st.floats(-3, 3))
def test_a_stream_has_changed_where_the_novelty_is_above_1(size: float, speed: float) -> None:
    row, y = new_streams(1)[0], 10**size * np.sin(np.arange(40) * 10**speed)
    start_monitoring(row, 1.0, 0.01)
    for _ in range(5):
        monitor_output(row, y, 20)
    ratio = np.mean(np.diff(y) ** 2) / (2 * np.pi * 0.01) ** 2
    assert output_changed(row, 20) == (novelty([float(np.mean(y * y))], [float(ratio)]) > 1)


def learned_from(source: MovingPictures, seed: int = 0, **settings: Any) -> ProgressLearner:
    learner = ProgressLearner(ProgressConfig(components=8, **settings), source.spec, seed)
    learn_blocks(source, learner, max_iterations=3000)
    return learner


def outcomes(learner: ProgressLearner) -> dict[str, str]:
    return {row["stream"]: row["state"] for row in learner.summary()["streams"]}


def encodes(learner: ProgressLearner, index: int, source: MovingPictures, stream: int) -> float:
    source.seek(0)
    block = source.take(stream, 3000)
    y = learner.modules[index].transform(block.frames)[:, 0]
    return float(abs(np.corrcoef(y, block.truth[:, 0])[0, 1]))


@pytest.mark.parametrize("seed", range(3))
def test_it_learns_what_is_there_gives_up_what_is_not_and_ends(seed: int) -> None:
    source = MovingPictures("noise", "swing", "constant", "stroll", seed=seed)
    learner = learned_from(source, seed)
    assert learner.over == "all_decided"
    assert outcomes(learner) == {
        "noise": "given_up",
        "swing": "learned",
        "constant": "given_up",
        "stroll": "learned",
    }
    assert sorted(m.stream for m in learner.modules) == ["stroll", "swing"]
    for place, module in enumerate(learner.modules):
        assert encodes(learner, place, source, module.stream_index) > 0.95
    rows = {row["stream"]: row for row in learner.summary()["streams"]}
    assert rows["noise"]["why"] == "no slow feature"
    assert rows["constant"]["why"] == "constant input"
    assert (rows["constant"]["slowness"], rows["noise"]["module"]) == (None, None)
    assert rows["swing"]["slowness"] < 0.05 < 0.15 < rows["noise"]["slowness"]


def test_the_same_stream_twice_is_learned_once_and_known() -> None:
    learner = learned_from(MovingPictures("swing", "noise", "swing.2"))
    assert len(learner.modules) == 1
    assert sorted(outcomes(learner).values()) == ["given_up", "known", "learned"]
    rows = learner.summary()["streams"]
    assert rows[0]["module"] == rows[2]["module"] == 1
    assert rows[0]["slowness"] == pytest.approx(rows[2]["slowness"], rel=0.1)


@pytest.mark.parametrize("attention", ["progress", "novel"])
def test_what_changes_is_learned_anew_or_known(attention: str) -> None:
    config = ProgressConfig(components=8, watch=10**6, attention=attention)
    source = MovingPictures("swing>stroll", "noise", seed=3, changes_at=250 * 40)
    learner = ProgressLearner(config, source.spec, 0)
    learn_blocks(source, learner, max_iterations=600)
    assert [m.stream for m in learner.modules] == 2 * ["swing>stroll"]
    assert learner.modules[0].iteration < 250 < learner.modules[1].iteration
    assert learner.summary()["streams"][0]["module"] == 2
    block = source.take(0, 3000)
    y = learner.modules[1].transform(block.frames)[:, 0]
    assert abs(np.corrcoef(y, block.truth[:, 0])[0, 1]) > 0.95
    source = MovingPictures("swing>stroll", "stroll", seed=3, changes_at=250 * 40)
    learner = ProgressLearner(config, source.spec, 0)
    learn_blocks(source, learner, max_iterations=600)
    assert len(learner.modules) == 2
    (changed, other) = learner.summary()["streams"]
    assert (changed["state"], changed["module"]) == ("known", other["module"])


def test_live_recorded_and_resumed_are_the_same_bit_for_bit(tmp_path: Path) -> None:
    names = ("noise", "swing", "constant", "stroll")
    live = run_session(MovingPictures(*names), CONFIG, tmp_path / "live", rerun=False)
    record(MovingPictures(*names), tmp_path / "log", frames=live.frames)
    recorded = run_session(
        open_recording([tmp_path / "log"]), CONFIG, tmp_path / "recorded", rerun=False
    )
    assert recorded.signals_sha256 == live.signals_sha256
    stopped = run_session(
        MovingPictures(*names), CONFIG, tmp_path / "run", max_iterations=37, keyframes=10
    )
    assert stopped.iterations == 37
    resumed = run_session(MovingPictures(*names), CONFIG, tmp_path / "run", resume=True)
    assert (resumed.signals_sha256, resumed.iterations) == (live.signals_sha256, live.iterations)
    assert resumed.summary == live.summary
    opened = Run(tmp_path / "run")
    frames = MovingPictures(*names).take(1, 5).frames
    for module, row in zip(opened.modules, live.as_json()["modules"], strict=True):
        assert (module.stream, module.stream_index) == (row["stream"], row["stream_index"])
        assert module.transform(frames).shape == (5, 16)
    assert opened.signals["state"].shape == (live.iterations, 4)


@given(st.sampled_from(sorted(RULES)), st.integers(1, 60))
def test_restored_anywhere_it_goes_on_alike(attention: str, k: int) -> None:
    source = MovingPictures("swing", "noise")
    config = ProgressConfig(components=8, attention=attention)
    one = ProgressLearner(config, source.spec, 5)
    for _ in range(k):
        one.step(source.take(one.stream, one.tau))
    two = ProgressLearner(config, source.spec, 5)
    two.restore(one.state)
    for _ in range(5):
        block = source.take(one.stream, one.tau)
        assert canonical_bytes(one.step(block)) == canonical_bytes(two.step(block))
    broken = one.state
    with pytest.raises(ValueError, match="streams is missing"):
        two.restore(type(broken)({}, (), broken.policy_rng))


def test_candidates_are_held_for_so_many_streams_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(held, "MAX_CANDIDATES", 3)
    names = [f"noise.{i}" for i in range(8)] + ["swing", "constant"]
    source = MovingPictures(*names)
    learner = ProgressLearner(CONFIG, source.spec, 0)
    most = 0
    while not learner.over:
        learner.step(source.take(learner.stream, learner.tau))
        state = learner.state
        most = max(most, len(state.arrays["held"]))
        assert learner.iteration < 2000
    assert most == 3
    assert [m.stream for m in learner.modules] == ["swing"]


def test_a_candidate_tests_before_it_learns() -> None:
    rng = np.random.default_rng(0)
    noise, swing = Candidate(192, 8, 1, 8000, 20), Candidate(192, 8, 1, 8000, 20)
    source = MovingPictures("swing")
    for k in range(15):
        noise.learn(rng.standard_normal((40, 192)), gap=k == 0)
        swing.learn(source.take(0, 40).frames.reshape(40, -1), gap=k == 0)
    assert noise.tests == swing.tests == 14
    assert noise.tested[0] == pytest.approx(WHITE_NOISE_SLOWNESS, rel=0.05)
    assert noise.fitted < noise.tested[0]
    assert relative_slowness(noise) > 0.85 > 0.4 > relative_slowness(swing)
    assert relative_fitted_slowness(noise) > 0.75 > 0.4 > relative_fitted_slowness(swing)
    assert rejection_reason(noise, ProgressConfig()) == "no slow feature"
    assert rejection_reason(swing, ProgressConfig()) == ""
    assert is_promising(swing, ProgressConfig())
    assert swing.error == learning_error(swing.change, swing.tested[0], swing.fitted)
    black = Candidate(192, 8, 1, 8000, 20)
    for _ in range(12):
        black.learn(np.zeros((40, 192), np.uint8), gap=False)
    assert (black.varies, rejection_reason(black, ProgressConfig())) == (False, "constant input")


@pytest.mark.parametrize("tau", [3, 40, 100])
def test_noise_is_as_fast_on_new_frames_as_it_is_however_short_a_block(tau: int) -> None:
    """What was learned by heart is in no step that is tested, not even from block to block."""
    rng = np.random.default_rng(1)
    candidate = Candidate(768, 8, 1, 8000, 100)
    for k in range(-(-2400 // tau)):
        candidate.learn(rng.standard_normal((tau, 768)), gap=k == 0)
    assert candidate.fitted < 0.98 * WHITE_NOISE_SLOWNESS
    assert candidate.tested[0] == pytest.approx(WHITE_NOISE_SLOWNESS, rel=0.03)


def test_a_test_is_of_weights_that_have_not_learned_from_its_frames() -> None:
    rng = np.random.default_rng(2)
    frames = np.cumsum(rng.standard_normal((100, 12)), axis=0)
    candidate = Candidate(12, 6, 2, 8000, 20)
    first, second, third = frames[:70], frames[70:80], frames[80:]
    candidate.learn(first, gap=True)
    assert np.isnan(candidate.y).all()
    phi, mean = candidate.sfa.phi, candidate.sfa.mean.copy()
    candidate.learn(second, gap=False)
    assert candidate.y == pytest.approx((second - mean) @ phi.T, abs=1e-9)
    later, mean = candidate.sfa.phi, candidate.sfa.mean.copy()
    between = phi @ (third[0] - second[-1])  # neither frame was known to these weights
    candidate.learn(third, gap=False)
    y = (third - mean) @ later.T
    steps = [
        (np.diff((second - mean) @ phi.T, axis=0) ** 2).mean(axis=0),
        (np.vstack([between, np.diff(y, axis=0)]) ** 2).mean(axis=0),
    ]
    variances = [candidate.variance, candidate.tested**2]
    assert variances[1] * (2 * np.pi) ** 2 * variances[0] == pytest.approx(np.mean(steps, axis=0))


@given(
    st.sampled_from(sorted(RULES)),
    st.lists(st.booleans(), min_size=1, max_size=6),
    st.integers(0, 2**32 - 1),
)
def test_every_rule_chooses_a_stream(name: str, learning: list[bool], seed: int) -> None:
    rng, n = np.random.default_rng(seed), len(learning)
    situation = Situation(
        stream=int(rng.integers(n)),
        learning=np.array(learning),
        changed=np.array(learning) & rng.integers(0, 2, n).astype(bool),
        errors={s: rng.random(int(rng.integers(ERROR_BLOCKS + 1))) for s in range(0, n, 2)},
        visits=rng.integers(1, 100, n),
        draws=rng.random(2),
        explore=0.1,
    )
    stream, drawn = RULES[name](situation)
    assert 0 <= stream < n
    if name != "random" and any(learning) and not drawn:
        assert learning[stream]


@pytest.mark.parametrize(
    ("name", "told", "draw", "chosen"),
    [
        ("novel", {"stream": 1, "learning": [1, 1, 0, 1], "visits": [3, 9, 99, 5]}, 0.5, 1),
        ("novel", {"learning": [1, 1, 0, 1], "changed": [0, 0, 0, 1]}, 0.5, 3),
        ("novel", {"learning": [1, 1, 0, 1]}, 0.05, 2),  # explores what was decided
        ("novel", {"learning": [1, 1, 1, 1], "visits": [1, 1, 2, 1]}, 0.05, 2),
    ],
)
def test_rules_choose_what_they_are_for(
    name: str, told: dict[str, Any], draw: float, chosen: int
) -> None:
    situation = Situation(
        stream=told.get("stream", 0),
        learning=np.array(told.get("learning", [1] * 4), bool),
        changed=np.array(told.get("changed", [0] * 4), bool),
        errors={},
        visits=np.array(told.get("visits", [9] * 4)),
        draws=np.array([draw, draw]),
        explore=0.1,
    )
    assert RULES[name](situation)[0] == chosen


def test_eight_outputs_are_decided_as_one_and_marked(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    names, config = ("noise", "swing", "stroll"), ProgressConfig(components=8)
    one = run_session(
        MovingPictures(*names), ProgressConfig(components=8, outputs=1), tmp_path / "one"
    )
    eight = run_session(MovingPictures(*names), config, tmp_path / "run", rerun=False)
    assert config.outputs == 8
    assert [(m.stream, m.iteration) for m in eight.modules] == [
        (m.stream, m.iteration) for m in one.modules
    ]
    frames, signals = MovingPictures("stroll").take(0, 3000).frames, Run(tmp_path / "run").signals
    document, opened = eight.as_json()["modules"], Run(tmp_path / "run").modules
    for single, module, row in zip(one.modules, opened, document, strict=True):
        assert module.eta[0] == pytest.approx(single.eta[0])
        assert module.slow[0] == 1
        assert 0 in module.slow
        assert row["slow"] == [bool(mark) for mark in module.slow]
        assert row["eta"] == signals["eta"][module.iteration].tolist() == module.eta.tolist()
        assert (module.eta[module.slow > 0] < 0.15).all()
    stroll = next(m for m in opened if m.stream == "stroll")
    assert stroll.slow.tolist() == [1] + 15 * [0]
    y = stroll.transform(frames)
    np.testing.assert_allclose(stroll.transform(frames, outputs=0), y[:, :1])
    said = cdmisfa("info", tmp_path / "run").out
    assert re.search(rf"{stroll.index} +stroll +\d+ +{stroll.eta[0]:.4f}, \(", said)
    assert "in brackets: not slow on new frames" in said
    result = cdmisfa("info", tmp_path / "run", "--json").json["modules"]
    assert [one["slow"] for one in result] == [m.slow.tolist() for m in opened]


@pytest.mark.parametrize("background", [0, 40])
def test_one_world_from_two_sides_is_known_and_another_is_not(background: int) -> None:
    """A picture that is shifted, and darker; the same spot where all else looks otherwise."""
    pattern = background * np.random.default_rng(2).normal(size=(12, 16))

    class Sides(MovingPictures):
        def take(self, stream: int, n: int) -> Block:
            block = super().take(stream, n)
            if stream:
                return block
            frames = (np.roll(block.frames, 1, axis=2) * 0.7 + pattern).clip(0, 255)
            return Block(stream, block.t, freeze(frames.astype(np.uint8)), block.truth)

    learner = learned_from(Sides("swing", "swing.2", "stroll"))
    first = "learned" if background else "known"
    assert sorted(outcomes(learner).values()) == [first, "learned", "learned"]
    assert len(learner.modules) == (3 if background else 2)
