"""The view of the progress learner tells what became of each stream, and no view has a gap."""

from __future__ import annotations

import fnmatch
import itertools

import numpy as np
import pytest
from conftest import Cdmisfa
from run_data import IMAGE, PROGRESS, UNTOLD, VECTOR, by_progress, write_run
from view_data import View, scalars

from replay.runs.run import read_outline
from replay.view.build import build_view

ITERATIONS = 30
TAU = 40


@pytest.fixture(scope="module", params=[IMAGE, VECTOR], ids=["images", "vectors"])
def shown(request, tmp_path_factory):
    """The records of a run of the progress learner, its folder, and what its view holds."""
    folder = tmp_path_factory.mktemp("run")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("replay.runs.log.BATCH_ITERATIONS", 7)  # lanes go on over pieces
        records = write_run(
            folder / "run.mcap",
            request.param,
            ITERATIONS,
            saves=True,
            learner=PROGRESS,
            edit=by_progress,
        )
        build_view(folder, folder / "run.rrd")
    return records, folder, View(folder / "run.rrd")


def test_each_stream_has_a_lane_that_says_what_became_of_it(shown):
    _, _, view = shown
    reported = {
        1: [(0, "not decided"), (10, "learned")],
        2: [(0, "not decided"), (10, "explained by module 1"), (22, "explained by module 2")],
        3: [(0, "not decided"), (10, "rejected"), (25, "not decided")],
    }
    for place, changes in reported.items():
        (entity,) = [e for e in view.rows if e.startswith(f"/state/{place}_")]
        expected = [(k * TAU, state) for k, state in changes]
        assert view.states(entity) == [*expected, (ITERATIONS * TAU, "")]


def test_each_stream_has_its_learning_error_where_it_was_watched(shown):
    records, folder, view = shown
    names = read_outline(folder).names()
    for s, name in enumerate(names):
        own = [r for r in records if r.stream == s]
        tested = np.array([np.isfinite(r.tested) for r in own])
        assert 0 < tested.sum() < len(own) or s == 2
        for signal in ("learning_error", "tested", "fitted", "change"):
            rows = view.rows[f"/streams/log_{signal}/{s + 1}_{name}"]
            expected = np.where(tested, [getattr(r, signal) for r in own], np.nan)
            result = dict(zip(rows["frame"], scalars(rows)[:, 0], strict=True))
            np.testing.assert_array_equal([result.pop(r.t) for r in own], np.log10(expected))
            ends = [a.t + TAU for a, b in itertools.pairwise(own) if b.t > a.t + TAU]
            assert list(result) == ends  # where the line ends: another stream is watched
            assert np.isnan(list(result.values())).all()
        result = view.numbers(f"/streams/interest/{s + 1}_{name}")
        np.testing.assert_array_equal(result, [r.interest[s] for r in records])


def test_nothing_is_there_that_the_run_does_not_tell(shown):
    names = shown[-1].names
    of_2_0 = ("/policy/", "/gate/", "/decision/R", "/decision/Q", "/decision/adv", "/abstraction/d")
    of_2_0 += tuple(f"/signals/{name}" for name in (*UNTOLD, "R"))
    of_2_0 += ("/candidate", "/novelty", "/action", "/action_choice", "/abstraction/s")
    assert [n for n in names if n.startswith(of_2_0)] == []
    assert {"/signals/learning_error", "/signals/state", "/signals/band_mean/1"} <= names


def has_something(view, entity):
    """Whether an entity has anything to show."""
    if entity not in view.rows:
        return not entity.startswith(("/signals", "/streams"))
    return "Scalars:scalars" not in view.rows[entity] or len(view.numbers(entity)) > 0


def check_no_view_is_empty(run):
    """Every view names entities that are there, each of them with something to show."""
    shown, checked = View(run / "run.rrd"), 0
    for name, wanted in shown.contents():
        for entity in wanted:
            pattern = entity.replace("**", "*")
            result = [n for n in shown.names if fnmatch.fnmatchcase(n, pattern)]
            assert any(has_something(shown, n) for n in result), (name, entity)
            checked += 1
    return checked


@pytest.mark.parametrize("algorithm", ["2.0", "1.0", "progress"])
def test_no_view_of_any_learner_is_empty(
    algorithm, cdmisfa: Cdmisfa, tmp_path, oscillatory_recording
):
    run = tmp_path / "run"
    words = ["learn", oscillatory_recording, "--loop", "--algorithm", algorithm, "-o", run]
    assert cdmisfa(*words, "--max-iterations", 60).code == 0
    assert check_no_view_is_empty(run) > 25
