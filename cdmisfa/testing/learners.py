"""What every `Learner` promises, as tests: say what to open.

class TestMine(LearnerContract):
    def open(self, spec, seed) -> Learner:
        return Mine(MineConfig(), spec, seed)
"""

from __future__ import annotations

import json

import numpy as np
import pytest

from cdmisfa.core.blocks import FrameSource, SeekableSource, SourceSpec
from cdmisfa.core.learning import Learner, LearnerState
from cdmisfa.core.signals import SignalsHash
from recorder.world.oscillatory import OscillatorySource


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
        other.restore(state)  # the state is a copy, which the learner went on without
        assert len(other.modules) == len(state.modules)
        source.seek(t)
        assert signals_sha256(other, source, self.iterations) == sha256
        assert (other.stream, other.iteration) == (learner.stream, learner.iteration)

    def test_a_state_that_is_not_its_own_is_refused(self) -> None:
        learner = self.open(self.source().spec, 0)
        state = learner.state
        with pytest.raises(ValueError, match=r".+"):
            learner.restore(LearnerState({}, (), state.policy_rng))
        assert learner.iteration == 0

    def test_a_block_that_was_not_asked_for_is_refused(self) -> None:
        source = self.source()
        learner = self.open(source.spec, 0)
        for stream, n in ((learner.stream, learner.tau + 1), (-1, learner.tau)):
            block = source.take(stream % len(source.spec.streams), n)
            if (block.stream, len(block)) != (learner.stream, learner.tau):
                with pytest.raises(ValueError, match=r".+"):
                    learner.step(block)
        assert learner.iteration == 0

    def test_its_weights_are_a_copy(self) -> None:
        learner = self.open(self.source().spec, 0)
        phi = learner.phi
        assert phi.ndim == 2
        phi[...] = np.nan
        assert not np.isnan(learner.phi).any()

    def test_its_summary_is_json(self) -> None:
        source = self.source()
        learner = self.open(source.spec, 0)
        signals_sha256(learner, source, self.iterations)
        summary = dict(learner.summary())
        assert json.loads(json.dumps(summary, allow_nan=False)) == summary
