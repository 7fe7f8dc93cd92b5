"""Tables that fit a terminal, and what a run's progress says."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import pytest
from contracts.learners import CONFIG
from hypothesis import given
from hypothesis import strategies as st
from rich.cells import cell_len

from cdmisfa.agents.learners import open_learner
from cdmisfa.cli import printing
from cdmisfa.cli.printing import fitting, print_table
from cdmisfa.cli.progress import Bar
from cdmisfa.experiments.loop import learn_blocks
from recorder.world.oscillatory import OscillatorySource


@given(st.lists(st.tuples(st.integers(0, 60), st.integers(0, 60)), min_size=1), st.integers(0, 200))
def test_columns_are_narrowed_as_far_as_needed_and_the_widest_first(
    columns: list[tuple[int, int]], room: int
) -> None:
    widths, least = zip(*columns, strict=True)
    found = fitting(widths, least, room)
    taken = sum(found) + 2 * (len(found) - 1)
    floor = [min(pair) for pair in columns]
    assert all(low <= now <= before for low, now, before in zip(floor, found, widths, strict=True))
    assert taken <= room or found == floor
    if found != list(widths):  # no more than needed, and what stayed is no wider than what did not
        assert taken >= room or found == floor
        narrowed = [now for now, before in zip(found, widths, strict=True) if now < before]
        stayed = [
            n for n, b, keeps in zip(found, widths, least, strict=True) if n == b and n > keeps
        ]
        assert max(stayed, default=0) <= max(narrowed) + 1


def test_a_table_on_a_terminal_fits_and_loses_nothing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [("x", "one two three four five six seven"), ("y", "unbroken" * 6)]
    print_table(("name", "about"), rows)
    piped = capsys.readouterr().out.splitlines()
    assert piped[2:] == [f"{name}     {about}" for name, about in rows]
    monkeypatch.setattr(printing.sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "24")
    print_table(("name", "about"), rows)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 24
    said = "".join(itertools.chain.from_iterable(line[6:].split() for line in lines[2:]))
    assert said == "".join(about.replace(" ", "") for _, about in rows)


def test_wide_letters_and_accents_take_the_places_that_a_terminal_gives_them(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    print_table(("name", "next"), [("カメラ", "x"), ("e\u0301", "y")])
    _, _, wide, accent = capsys.readouterr().out.splitlines()
    assert (wide, accent) == ("カメラ  x", "e\u0301       y")
    monkeypatch.setattr(printing.sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "12")
    print_table(("a", "b"), [("左" * 12, "x")])
    lines = capsys.readouterr().out.splitlines()
    assert max(map(cell_len, lines)) <= 12
    assert "".join(lines).count("左") == 12


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


def test_progress_knows_its_length_where_frames_end_or_iterations_are_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("cdmisfa.cli.progress.TICK", 0.0)
    for length, most, total in ((1030, None, 20), (1030, 7, 7), (None, 7, 7), (200, 7, 4)):
        source, shown = OscillatorySource(), Seen()
        spec = dataclasses.replace(source.spec, length=length)
        learner = open_learner(dataclasses.replace(CONFIG, tau=50), spec, 0)
        learn_blocks(source, learner, (shown.sink(spec, most),), max_iterations=4)
        assert [told[:2] for told in shown.told] == [(k, total) for k in range(1, 5)]
