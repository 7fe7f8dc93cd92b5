"""What every `Learner` and `Sink` promises, as tests: say what to open.

class TestMine(LearnerContract):
    def open(self, spec, seed) -> Learner:
        return Mine(MineConfig(), spec, seed)

class TestDigest(SinkContract):
    def open(self, folder, source, learner) -> Sink:
        return Digest()
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cdmisfa.agents.learner import CuriousLearner
from cdmisfa.core.blocks import FrameSource, SeekableSource, SourceSpec
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.learning import Learner, LearnerState, Sink
from cdmisfa.core.signals import SignalsHash
from cdmisfa.experiments.loop import Digest, learn_blocks
from recorder.world.oscillatory import OscillatorySource

CONFIG = LearnerConfig(
    tau=40, eta_dot_window=8, warm_up=3, delta=1.0, min_variance=1e-6, novel_share=0.0
)
"""Saves its first module at iteration 8."""

Opened = tuple[OscillatorySource, CuriousLearner, Sink]


def signals_sha256(learner: Learner, source: FrameSource, iterations: int) -> str:
    """Have a learner watch so many blocks, and say what came of it."""
    digest = SignalsHash()
    for _ in range(iterations):
        digest.add(learner.step(source.take(learner.stream, learner.tau)))
    return digest.hexdigest()


class LearnerContract:
    """The tests; a subclass opens a fresh learner in `open`.

    Attributes:
        iterations: how many blocks some tests have it watch, twice.
    """

    iterations = 12

    def open(self, spec: SourceSpec, seed: int) -> Learner:
        """Open a fresh learner of the kind under test."""
        raise NotImplementedError

    def source(self) -> SeekableSource:
        """What it learns from; by default three streams of values."""
        return OscillatorySource()

    def test_it_is_a_learner(self) -> None:
        spec = self.source().spec
        learner = self.open(spec, 0)
        assert isinstance(learner, Learner)
        assert learner.iteration == 0
        assert list(learner.modules) == []
        assert 0 <= learner.stream < len(spec.streams)
        assert learner.tau >= 1
        assert learner.over == ""
        phi = learner.phi
        assert phi.ndim == 2
        phi[...] = np.nan
        assert not np.isnan(learner.phi).any(), "phi is a copy"

    def test_signals_are_of_the_block_that_was_watched(self) -> None:
        source = self.source()
        learner = self.open(source.spec, 0)
        for iteration in range(3):
            block = source.take(learner.stream, learner.tau)
            signals = learner.step(block)
            assert (signals.iteration, signals.t) == (iteration, block.t)
            assert (signals.stream, signals.log_time) == (
                block.stream,
                source.spec.time_ns(block.t),
            )
            assert learner.iteration == iteration + 1

    def test_the_same_seed_gives_the_same_bits(self) -> None:
        one, two = (self.open(self.source().spec, 3) for _ in range(2))
        sha256 = signals_sha256(one, self.source(), self.iterations)
        assert signals_sha256(two, self.source(), self.iterations) == sha256

    def test_a_learner_that_is_restored_goes_on_the_same(self) -> None:
        source = self.source()
        learner, other = (self.open(source.spec, 3) for _ in range(2))
        signals_sha256(learner, source, self.iterations)
        t, state = source.t, learner.state
        sha256 = signals_sha256(learner, source, self.iterations)
        other.restore(state)  # a copy, which did not change when the learner went on
        assert len(other.modules) == len(state.modules)
        source.seek(t)
        assert signals_sha256(other, source, self.iterations) == sha256
        assert (other.stream, other.iteration) == (learner.stream, learner.iteration)
        summary = dict(learner.summary())
        assert json.loads(json.dumps(summary, allow_nan=False)) == summary

    def test_what_is_not_its_own_is_refused(self) -> None:
        source = self.source()
        learner = self.open(source.spec, 0)
        with pytest.raises(ValueError, match=r".+"):
            learner.restore(LearnerState({}, (), learner.state.policy_rng))
        for stream, n in ((learner.stream, learner.tau + 1), (-1, learner.tau)):
            block = source.take(stream % len(source.spec.streams), n)
            if (block.stream, len(block)) != (learner.stream, learner.tau):
                with pytest.raises(ValueError, match=r".+"):
                    learner.step(block)
        assert learner.iteration == 0


class SinkContract:
    """The tests; a subclass opens a fresh sink for a run in `open`."""

    def open(self, folder: Path, source: OscillatorySource, learner: Learner) -> Sink:
        """Open a fresh sink of the kind under test."""
        raise NotImplementedError

    @pytest.fixture
    def opened(self, tmp_path: Path) -> Iterator[Opened]:
        """A source, a learner for it, and a sink for their run."""
        source = OscillatorySource()
        learner = CuriousLearner(CONFIG, source.spec, seed=3)
        sink = self.open(tmp_path, source, learner)
        context: Any = sink if hasattr(sink, "__exit__") else contextlib.nullcontext()
        with context:
            yield source, learner, sink
        if hasattr(sink, "abandon"):  # a log whose run did not finish it
            sink.abandon()

    def test_it_changes_nothing_of_a_run(self, opened: Opened) -> None:
        source, learner, sink = opened
        digest, alone = Digest(), Digest()
        learn_blocks(source, learner, (sink, digest), max_iterations=20, max_modules=9)
        assert len(learner.modules) == 1
        other = CuriousLearner(CONFIG, source.spec, seed=3)
        learn_blocks(OscillatorySource(), other, (alone,), max_iterations=20, max_modules=9)
        assert digest.hexdigest() == alone.hexdigest()
        state, expected = learner.state, other.state
        assert state.policy_rng == expected.policy_rng
        for name, array in expected.arrays.items():
            assert state.arrays[name].tobytes() == array.tobytes(), name

    def test_it_takes_a_run_without_blocks(self, opened: Opened) -> None:
        source, learner, sink = opened
        assert isinstance(sink, Sink)
        assert learn_blocks(source, learner, (sink,), max_iterations=0) == "max_iterations"

    def test_it_takes_events_of_every_level(self, opened: Opened) -> None:
        source, learner, sink = opened
        signals = learner.step(block := source.take(learner.stream, learner.tau))
        sink.block(block, signals, learner)
        for level in ("INFO", "WARNING"):
            sink.event(source.t, 0, "it rains", level)
        sink.finish()
