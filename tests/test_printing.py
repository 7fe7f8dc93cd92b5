"""Tables that fit a terminal, and what a run's progress says."""

from __future__ import annotations

from typing import Any

import pytest
from contracts.learners import CONFIG

from cdmisfa.agents.learners import open_learner
from cdmisfa.cli.progress import Bar
from cdmisfa.experiments.loop import learn_blocks
from recorder.world.oscillatory import OscillatorySource


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
    learner = open_learner(CONFIG, source.spec, 0)
    sink = shown.sink(source.spec, None)
    learn_blocks(source, learner, (sink,), max_modules=1)
    *before, (done, total, note) = shown.told
    assert (done, total) == (learner.iteration, None)
    (module,) = learner.modules
    assert note.startswith(f"watching {module.stream}, saved last: module 1 of {module.stream}, ")
    assert all("nothing saved yet" in words for *_, words in before)
    assert {words.split(",")[0] for *_, words in before} == {
        f"watching {name}" for name in source.spec.streams
    }
    (line,) = shown.said
    assert line.startswith(f"iteration {learner.iteration - 1}: module 1 saved on stream")
