"""The loop: what it asks, what it tells whom and when, and every sink there is."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from contracts.learners import CONFIG, SinkContract

from cdmisfa.agents.learner import CuriousLearner
from cdmisfa.cli.progress import Bar
from cdmisfa.core.blocks import Block
from cdmisfa.core.learning import Learner, Sink
from cdmisfa.core.outcomes import END_REASONS
from cdmisfa.core.signals import BlockSignals
from cdmisfa.experiments.loop import Digest, Keyframes, learn_blocks
from recorder.world.oscillatory import OscillatorySource
from replay.runs.writer import RunWriter


class Notes(Sink):
    """Notes what it is told."""

    def __init__(self) -> None:
        self.told: list[object] = []

    def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
        assert (block.t, block.stream) == (signals.t, signals.stream)
        assert learner.iteration == signals.iteration + 1
        self.told.append(signals.iteration)

    def event(self, t: int, iteration: int, text: str, level: str = "INFO") -> None:
        self.told.append((t, iteration, text, level))

    def finish(self) -> None:
        self.told.append("finished")


class TestNotes(SinkContract):
    def open(self, folder: Path, source: OscillatorySource, learner: Learner) -> Sink:
        return Notes()


class TestDigest(SinkContract):
    def open(self, folder: Path, source: OscillatorySource, learner: Learner) -> Sink:
        return Digest()


class TestRunWriter(SinkContract):
    def open(self, folder: Path, source: OscillatorySource, learner: Learner) -> Sink:
        return RunWriter(folder / "run.mcap", source.spec, {})


class TestKeyframes(SinkContract):
    def open(self, folder: Path, source: OscillatorySource, learner: Learner) -> Sink:
        self.log = RunWriter(folder / "run.mcap", source.spec, {})
        return Keyframes(self.log, source, learner, {}, 7)

    @pytest.fixture(autouse=True)
    def abandoned(self) -> Iterator[None]:
        yield
        self.log.abandon()


class TestLiveView(SinkContract):
    def open(self, folder: Path, source: OscillatorySource, learner: Learner) -> Sink:
        from replay.view.live import LiveView

        return LiveView(source.spec, {}, learner.tau, len(learner.phi))


class TestReporter(SinkContract):
    def open(self, folder: Path, source: OscillatorySource, learner: Learner) -> Sink:
        return Bar().sink(source.spec, None)


def learner_for(source: OscillatorySource) -> CuriousLearner:
    return CuriousLearner(CONFIG, source.spec, seed=3)


def test_every_sink_is_told_everything_in_order() -> None:
    source, one, two = OscillatorySource(), Notes(), Notes()
    assert learn_blocks(source, learner_for(source), (one, two), max_modules=1) == "max_modules"
    saved, ended, finished = one.told[-3:]
    assert one.told[:-3] == list(range(9))
    assert saved == (320, 8, "module 1 saved on stream x2, policy [1, 1, 1]", "INFO")
    assert (ended, finished) == (
        (360, 8, f"ended: {END_REASONS['max_modules']}", "INFO"),
        "finished",
    )
    assert two.told == one.told


def test_the_end_of_a_recording_ends_the_run_and_is_told() -> None:
    source, notes = OscillatorySource(length=130), Notes()
    assert learn_blocks(source, learner_for(source), (notes,)) == "log_exhausted"
    (t, iteration, why, level), *last = notes.told[3:]
    assert (notes.told[:3], t, iteration, level) == ([0, 1, 2], 120, 2, "WARNING")
    assert "the streams end at frame 130" in why
    assert last == [(120, 2, f"ended: {END_REASONS['log_exhausted']}", "INFO"), "finished"]


class Seen(Bar):
    """Keeps what it is told."""

    def __init__(self) -> None:
        self.told: list[Any] = []
        self.said: list[str] = []

    def update(self, done: float, total: float | None = None, note: str = "") -> None:
        self.told.append((done, total, note))

    def say(self, line: str) -> None:
        self.said.append(line)


def test_progress_says_what_is_watched_and_what_was_saved_last(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("cdmisfa.cli.progress.TICK", 0.0)
    source, shown = OscillatorySource(), Seen()
    learner = CuriousLearner(CONFIG, source.spec, 0)
    sink = shown.sink(source.spec, None)
    learn_blocks(source, learner, (sink,), max_modules=1)
    *before, (done, total, note) = shown.told
    assert (done, total) == (learner.iteration, None)
    (module,) = learner.modules
    assert note.startswith(f"attending to {module.stream}, last module: 1 of {module.stream}, ")
    assert all("no module yet" in words for *_, words in before)
    assert {words.split(",")[0] for *_, words in before} == {
        f"attending to {name}" for name in source.spec.streams
    }
    (line,) = shown.said
    assert line.startswith(f"iteration {learner.iteration - 1}: module 1 saved on stream")
