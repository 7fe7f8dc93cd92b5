"""What every `Sink` promises, as tests: say what to open.

class TestDigest(SinkContract):
    def open(self, folder, source, learner) -> Sink:
        return Digest()
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from cdmisfa.agents.learner import CuriousLearner
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.learning import Learner, Sink
from cdmisfa.experiments.loop import Digest, learn
from recorder.world.oscillatory import OscillatorySource

CONFIG = LearnerConfig(
    tau=40, eta_dot_window=8, warm_up=3, delta=1.0, min_variance=1e-6, novel_share=0.0
)
"""Saves its first module at iteration 8."""

Opened = tuple[OscillatorySource, CuriousLearner, Sink]


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

    def test_it_is_a_sink(self, opened: Opened) -> None:
        assert isinstance(opened[2], Sink)

    def test_it_changes_nothing_of_a_run(self, opened: Opened) -> None:
        source, learner, sink = opened
        digest, alone = Digest(), Digest()
        learn(source, learner, (sink, digest), max_iterations=20, max_modules=9)
        assert len(learner.modules) == 1
        other = CuriousLearner(CONFIG, source.spec, seed=3)
        learn(OscillatorySource(), other, (alone,), max_iterations=20, max_modules=9)
        assert digest.hexdigest() == alone.hexdigest()
        state, expected = learner.state, other.state
        assert state.policy_rng == expected.policy_rng
        for name, array in expected.arrays.items():
            assert state.arrays[name].tobytes() == array.tobytes(), name

    def test_it_takes_a_run_without_blocks(self, opened: Opened) -> None:
        source, learner, sink = opened
        assert learn(source, learner, (sink,), max_iterations=0) == "max_iterations"

    def test_it_takes_events_of_every_level(self, opened: Opened) -> None:
        source, learner, sink = opened
        signals = learner.step(block := source.take(learner.stream, learner.tau))
        sink.block(block, signals, learner)
        for level in ("INFO", "WARNING"):
            sink.event(source.t, 0, "it rains", level)
        sink.finish()
