"""The view of the progress learner tells what became of each stream, and no view has a gap."""

from __future__ import annotations

import dataclasses
import fnmatch
import itertools

import numpy as np
import pytest
import rerun.blueprint as rrb
from conftest import Cdmisfa
from run_data import (
    IMAGE,
    PROGRESS,
    UNTOLD,
    VECTOR,
    by_progress,
    module_of,
    parts_of,
    write_run,
)
from view_data import View, scalars, tabs_of, views_of

from cdmisfa.core.signals import NO_STATE
from replay.palette import CYCLE, packed
from replay.runs.modules import save_modules
from replay.runs.run import read_outline
from replay.view.build import build_view
from replay.view.summary import summary_text

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
    told = {
        1: [(0, "learning"), (10, "learned")],
        2: [(0, "learning"), (10, "known by 1"), (22, "known by 2")],
        3: [(0, "learning"), (10, "given up"), (25, "learning")],
    }
    for place, changes in told.items():
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
            found = dict(zip(rows["frame"], scalars(rows)[:, 0], strict=True))
            np.testing.assert_array_equal([found.pop(r.t) for r in own], np.log10(expected))
            ends = [a.t + TAU for a, b in itertools.pairwise(own) if b.t > a.t + TAU]
            assert list(found) == ends  # where the line ends: another stream is watched
            assert np.isnan(list(found.values())).all()
        found = view.numbers(f"/streams/interest/{s + 1}_{name}")
        np.testing.assert_array_equal(found, [r.interest[s] for r in records])


def test_saves_and_thresholds_are_marked(shown):
    records, _, view = shown
    saved = [r for r in records if r.saved]
    assert view.rows["/streams/saved"]["frame"] == [r.t for r in saved]
    assert view.numbers("/streams/saved").tolist() == [np.log10(r.learning_error) for r in saved]
    assert set(view.numbers("/streams/threshold")) == {np.log10(0.05 + 0.25)}
    assert set(view.numbers("/streams/settled")) == {np.log10(0.05)}


def test_nothing_is_there_that_the_run_does_not_tell(shown):
    names = shown[-1].names
    of_2_0 = ("/policy/", "/gate/", "/decision/R", "/decision/Q", "/decision/adv", "/abstraction/d")
    of_2_0 += tuple(f"/signals/{name}" for name in (*UNTOLD, "R"))
    of_2_0 += ("/learns", "/novelty", "/mostly/novelty", "/does", "/explores", "/abstraction/s")
    assert [n for n in names if n.startswith(of_2_0)] == []
    assert {"/signals/learning_error", "/signals/state", "/signals/band_mean/1"} <= names


def test_what_2_0_tells_has_nothing_of_streams(tmp_path):
    missing = {"change": np.nan, "tested": np.nan, "fitted": np.nan, "learning_error": np.nan}

    def plain(signals):
        none = np.full(3, np.nan), np.full(3, NO_STATE)
        return dataclasses.replace(signals, **missing, interest=none[0], state=none[1])

    write_run(tmp_path / "run.mcap", VECTOR, 12, edit=plain, learner={"algorithm": "2.0"})
    build_view(tmp_path, tmp_path / "run.rrd")
    names = View(tmp_path / "run.rrd").names
    new = tuple(f"/signals/{name}" for name in (*missing, "interest", "state"))
    assert [n for n in names if n.startswith(("/streams", *new))] == []
    assert {"/signals/Q", "/signals/xi", "/novelty"} <= names


def has_something(view, entity):
    """Whether an entity has anything to show."""
    if entity not in view.rows:
        return not entity.startswith(("/signals", "/streams"))
    return "Scalars:scalars" not in view.rows[entity] or len(view.numbers(entity)) > 0


def check_no_view_is_empty(run):
    """Every view names entities that are there, each of them with something to show."""
    shown, checked = View(run / "run.rrd"), 0
    for tab in tabs_of(run).values():
        for view in views_of(tab):
            if isinstance(view, rrb.DataframeView):
                query = view.properties["DataframeQuery"]
                (wanted,) = query.entity_order.as_arrow_array().to_pylist()
            elif isinstance(view.contents, list):
                wanted = view.contents
            else:
                wanted = [view.origin]
            for entity in wanted:
                found = [
                    n for n in shown.names if fnmatch.fnmatchcase(n, entity.replace("**", "*"))
                ]
                assert found, (tab.name, view.name, entity)
                assert any(has_something(shown, n) for n in found), (tab.name, view.name, entity)
                checked += 1
    return checked


def test_the_gate_and_the_decision_have_no_tab(shown):
    _, folder, _ = shown
    assert list(tabs_of(folder)) == ["Overview", "Candidate", "Modules", "Table"]


@pytest.mark.parametrize("algorithm", ["2.0", "1.0", "progress"])
def test_no_view_of_any_learner_is_empty(
    algorithm, cdmisfa: Cdmisfa, tmp_path, oscillatory_recording
):
    run = tmp_path / "run"
    words = ["learn", oscillatory_recording, "--loop", "--algorithm", algorithm, "-o", run]
    assert cdmisfa(*words, "--max-iterations", 60).code == 0
    assert check_no_view_is_empty(run) > 25


def test_a_short_run_shows_its_weights_and_says_why_there_is_no_interest(
    cdmisfa: Cdmisfa, tmp_path, oscillatory_recording
):
    words = ["learn", oscillatory_recording, "--algorithm", "progress", "-o", tmp_path / "run"]
    assert cdmisfa(*words, "--max-iterations", 8).code == 0
    *_, (t, phi) = parts_of(tmp_path / "run", "phi")
    assert (t, bool(phi.any())) == (7 * 40, True)
    view = View(tmp_path / "run" / "run.rrd")
    assert view.rows["/abstraction/phi"]["frame"][-1] == t
    none = "no line yet: none was watched long enough"
    assert any(name.endswith(none) for name in view.titles())


def test_the_summary_says_what_became_of_each_stream(shown):
    _, folder, _ = shown
    first, second, third = read_outline(folder).names()
    events = [
        f"stream {first} is learned by module 1 after 9 blocks, slowness 0.0500",
        f"stream {second} is known by module 1 (of {first}) after 4 blocks, slowness 0.0600",
        f"stream {third} is given up after 3 blocks: it is constant",
        f"looking once more at what was given up: {third}",
        f"stream {second} is known by module 2 (of {first}) after 8 blocks, slowness 0.0400",
        "ended: nothing was left",
    ]
    text = summary_text(read_outline(folder), "run", events)
    assert "1 learning, 1 learned, 1 known" in text
    assert f"- **{first}**: learned by module 1 after 9 blocks, slowness 0.0500" in text
    assert f"- **{second}**: known by module 2 (of {first}) after 8 blocks" in text
    assert f"- **{third}**: being learned" in text
    assert "It ended: nothing was left." in text


def test_weights_are_those_of_the_stream_that_is_shown(tmp_path):
    """The log has at the end of each block those of the stream that comes next."""

    def turn(record):
        turned = by_progress(record)
        return dataclasses.replace(turned, next_stream=(record.iteration + 1) % 3, action=1)

    write_run(tmp_path / "run.mcap", VECTOR, 12, learner=PROGRESS, edit=turn)
    build_view(tmp_path, tmp_path / "run.rrd")
    shown = View(tmp_path / "run.rrd").rows["/abstraction/phi"]
    bars = [set(values["buffer"]) for (values,) in shown["BarChart:values"]]
    assert shown["iteration"] == list(range(1, 12))
    assert bars == [{float(k - 1)} for k in shown["iteration"]]


def test_a_module_hangs_its_weights_with_what_is_slow_and_frames_by_output(tmp_path):
    records = write_run(
        tmp_path / "run.mcap", IMAGE, ITERATIONS, learner=PROGRESS, edit=by_progress
    )
    rng, size = np.random.default_rng(0), 12 * 16
    module = module_of(1, 8, rng.standard_normal((2, size)))
    module = dataclasses.replace(module, slow=np.array([1, 0]), eta=np.ones(2))
    save_modules(
        tmp_path / "modules.npz",
        [dataclasses.replace(module, band_mean=np.ones(2), band_sd=np.ones(2))],
    )
    build_view(tmp_path, tmp_path / "run.rrd")
    view = View(tmp_path / "run.rrd")
    words = [view.static[f"/modules/1/weights/{j}/words"]["Points2D:labels"] for j in (1, 2)]
    assert words == [["1 slow"], ["2 not slow"]]
    output = view.static["/modules/1/output"]
    assert output["SeriesLines:names"] == ["output 1"]
    assert output["SeriesLines:colors"] == [packed(CYCLE[0])]  # of left, which its tab names
    rows = [f"/modules/1/sheet/{row}" for row in ("1_least", "2_middle", "3_greatest")]
    said = [view.static[f"{row}/words"]["Points2D:labels"][0] for row in rows]
    ends = [[float(x) for x in text.split(": ")[1].split(" to ")] for text in said]
    assert ends == sorted(ends)
    y = view.numbers("/modules/1/output")
    assert (ends[0][0], ends[-1][-1]) == (round(y.min(), 2), round(y.max(), 2))
    assert {r.stream for r in records} == {0, 1, 2}
