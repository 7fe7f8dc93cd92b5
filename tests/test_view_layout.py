"""The view does not mislead: how lines are drawn, what their axes hold, what colours mean."""

from __future__ import annotations

import dataclasses
import re
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
import rerun.blueprint as rrb
from run_data import IMAGE, PROGRESS, VECTOR, write_run
from view_data import View, scalars, tabs_of, views_of

from cdmisfa.core.errors import UsageError
from recorder.recording import record_scene
from recorder.world.oscillatory import OscillatoryConfig
from replay.palette import CYCLE, packed
from replay.runs.run import read_outline
from replay.view import lanes
from replay.view.build import build_view
from replay.view.layouts import WorldTab
from replay.view.panels import run_layout

ITERATIONS, TAU = 420, 40
MIN_MAX = rr.components.AggregationPolicy.MinMax.value

LEARNERS = {"2.0": {"algorithm": "2.0"}, "progress": PROGRESS}


@pytest.fixture(scope="module", params=LEARNERS)
def built(request, tmp_path_factory):
    """The view of a run whose last module is saved in its last iteration."""
    folder = tmp_path_factory.mktemp("run")
    records = write_run(
        *(folder / "run.mcap", IMAGE, ITERATIONS),
        saves=True,
        learner=LEARNERS[request.param],
        edit=lambda record: dataclasses.replace(record, eta=np.abs(record.eta)),
    )
    assert (records[-1].saved, len(records[-1].y_frozen)) == (True, 2)
    build_view(folder, folder / "run.rrd")
    return View(folder / "run.rrd"), records, folder


def test_no_line_is_a_mean(built):
    view, *_ = built
    drawn = [e for e, columns in view.rows.items() if "Scalars:scalars" in columns]
    assert len(drawn) > 30
    marks = {e for e in drawn if "SeriesPoints:markers" in view.static[e]}
    for entity in set(drawn) - marks:
        assert view.static[entity]["SeriesLines:aggregation_policy"] == [MIN_MAX], entity
    assert {e.rpartition("/")[2] for e in marks} == {"saved"}


def test_a_recording_has_every_frame_and_its_lines_are_no_means_either(tmp_path):
    record_scene("oscillatory", tmp_path / "r", OscillatoryConfig(), frames=50)
    build_view(tmp_path / "r", tmp_path / "r.rrd")
    view = View(tmp_path / "r.rrd")
    for entity in ("/views/1_x1", "/views/2_x2", "/views/3_x3", "/world/truth"):
        assert view.rows[entity]["frame"] == list(range(50))
        assert view.static[entity]["SeriesLines:aggregation_policy"] == [MIN_MAX]


def test_axes_hold_what_is_drawn_and_leave_room_for_the_legend(built):
    view, *_ = built
    plots, held = view.views("TimeSeries"), 0
    for name, entities, time, values, legend in plots:
        assert entities, name
        if values is not None:
            drawn = np.concatenate([view.numbers(e) for e in entities])
            assert values[0] <= drawn.min() <= drawn.max() <= values[1], name
            held += 1
        if time is not None and time["start"] == 0:
            assert time["end"] >= 1.1 * ITERATIONS * TAU, name
        elif time is not None:  # a window of frames up to the cursor, or up to a save
            assert time["end"] - time["start"] < 20 * TAU, name
        says = any(word in name.lower() for word in ("slowness", "(grey)", "rule", "q of"))
        assert legend is True or len(entities) == 1 or says, name
    assert held >= 4
    assert sum(time["start"] < 0 < time["end"] for _, _, time, *_ in plots if time) >= 2


def test_lanes_have_few_states_and_plain_names(built):
    view, records, _ = built
    for name, entities, time, *_ in view.views("StateTimeline"):
        window = time["end"] - time["start"]
        for entity in entities:
            begins = [t for t, _ in view.states(entity)]
            shown = len(begins) if window > ITERATIONS * TAU else window // TAU + 1
            random = entity.startswith(("/policy", "/state"))  # real ones do not change each block
            assert random or shown <= lanes.PIECES * 5 / 4, (name, entity)
            assert re.fullmatch(r"(/[a-z0-9_]+){1,2}", entity)
    pieces = view.states("/mostly/attends")
    blocks = ITERATIONS // lanes.PIECES
    for k in range(0, ITERATIONS, blocks):
        own = [IMAGE.streams[s.stream] for s in records[k : k + blocks]]
        most = max(own, key=own.count)
        said = [state for t, state in pieces if t <= k * TAU][-1]
        assert said == (most if own.count(most) >= 2 / 3 * len(own) else "switches")


def test_a_colour_means_one_thing(built):
    """A full colour is a stream's, whatever is told of it; no state and no line shares it."""
    view, *_ = built
    meaning = defaultdict(set)
    for entity, parts in view.static.items():
        names = parts.get("StateConfiguration:values", [])
        for state, rgb in zip(names, parts.get("StateConfiguration:colors", []), strict=True):
            own = [s for s in IMAGE.streams if state == "stay" and entity.endswith(f"_{s}")]
            stream = own or [s for s in IMAGE.streams if s in state.split()]
            kind = stream[0] if stream else state.partition(" ")[0]
            meaning[rgb].add("mixed" if kind in ("switches", "both", "switch") else kind)
        for rgb in parts.get("SeriesLines:colors", []):
            named = [s for s in IMAGE.streams if s in " ".join(parts["SeriesLines:names"])]
            told = entity.startswith(("/signals/", "/modules/"))  # a tab names its stream
            assert named or told or rgb not in map(packed, CYCLE), entity
    assert len(meaning) > 5
    assert {rgb: kinds for rgb, kinds in meaning.items() if len(kinds) > 1} == {}
    assert [meaning[packed(rgb)] for rgb in CYCLE[:3]] == [{name} for name in IMAGE.streams]


def test_every_module_is_shown_also_the_last(built):
    view, records, _ = built
    saved = {r.module: r for r in records if r.saved}
    assert list(saved) == [1, 2, 3]
    for number, record in saved.items():
        name = IMAGE.streams[record.stream]
        assert f"Module {number}: {name}" in view.titles()
        mark = view.rows[f"/modules/{number}/saved"]
        assert (mark["frame"], mark["iteration"]) == ([record.t + TAU], [record.iteration])
        later = [r.t for r in records if r.stream == record.stream and r.t > record.t]
        ends = {
            time["end"] - 42: time["start"]
            for n, e, time, *_ in view.views("TimeSeries")
            if f"/modules/{number}/saved" in e and "last 300" in n
        }
        stops = [record.t + TAU, *(t + TAU for t in later[-1:])]
        assert ends == {t: t - 300 for t in stops}


def test_without_modules_an_output_is_what_the_signals_tell_of_its_own_stream(built):
    """Of a run that was broken off, from the save on: the file of modules comes at the end."""
    view, records, _ = built
    for number in (1, 2):
        (save,) = [r for r in records if r.saved and r.module == number]
        own = [r for r in records if r.stream == save.stream and r.t > save.t]
        output = view.rows[f"/modules/{number}/output"]
        said = dict(zip(output["frame"], scalars(output)[:, 0], strict=True))
        told = {t: y for t, y in said.items() if np.isfinite(y)}
        expected = {r.t + i: r.y_frozen[number - 1, i, 0] for r in own for i in range(TAU)}
        assert told == expected
        weights = view.rows[f"/modules/{number}/weights"]
        assert weights["frame"] == [save.t]


def test_few_modules_have_a_page_each_and_many_stand_on_pages(tmp_path):
    write_run(tmp_path / "run.mcap", VECTOR, 3)
    for count, pages in (
        (2, ["Module 1", "Module 2"]),
        (14, ["1 to 6", "7 to 12", "13 to 14"]),
        (100, None),
    ):
        outline = dataclasses.replace(read_outline(tmp_path), modules=count)
        layout = run_layout(outline, WorldTab(), tab="modules")
        tabs = layout.root_container.contents
        (modules,) = [tab for tab in tabs if tab.name == "Modules"]
        names = [page.name for page in modules.contents]
        assert len(names) == (18 if pages is None else len(pages) + 1)
        assert pages is None or names == [*pages, "Events"]
        shown = [view.origin for view in views_of(modules) if "weights" in str(view.origin)]
        assert shown == [f"/modules/{i}/weights" for i in range(1, count + 1)]
        assert layout.root_container.active_tab == tabs.index(modules)
    with pytest.raises(UsageError, match=r"no tab 'nowhere': there are Overview, .*Table"):
        run_layout(outline, WorldTab(), tab="nowhere")


def rows_at_1280x720(tab):
    """Height of each row of a column of views on a small screen."""
    (column,) = [part for part in (tab, *tab.contents) if isinstance(part, rrb.Vertical)][-1:]
    heights = 624 * np.array(column.row_shares) / sum(column.row_shares)
    return dict(zip(column.contents, heights, strict=True))


@pytest.mark.parametrize("learner", LEARNERS)
def test_a_small_screen_shows_each_lane(learner, tmp_path):
    write_run(tmp_path / "run.mcap", IMAGE, 3, learner=LEARNERS[learner])
    world, lanes = WorldTab(), 0
    layout = run_layout(read_outline(tmp_path), world).root_container
    for tab in layout.contents:
        if tab.name in ("Overview", "Gate", "Candidate"):
            for view, height in rows_at_1280x720(tab).items():
                if isinstance(view, rrb.StateTimelineView):
                    shown = [
                        3 if "policy" in e or "state" in e else 2 if "mostly/**" in e else 1
                        for e in view.contents
                    ]
                    shown = sum(shown) - ("state" in str(view.contents))
                    assert height >= 55 + 40 * shown
                    lanes += 1
                else:
                    assert height >= 60
    assert lanes >= 2


def test_a_run_is_played_in_a_minute(built):
    view, *_ = built
    fps = view.layout["/time_panel"]["TimePanelBlueprint:fps"]
    assert 55 < ITERATIONS * TAU / fps < 65


def test_the_picture_has_the_name_of_its_stream(built):
    view, records, _ = built
    rows = view.rows["/world/watched/name"]
    labels = [text for (text,) in rows["Boxes2D:labels"]]
    named, stream = dict(zip(rows["frame"], labels, strict=True)), None
    for record in records:
        stream = named.get(record.t, stream)
        assert stream == IMAGE.streams[record.stream]


VERDICT = "Verdict on each block: the last 50 blocks"
RULES = "Rule 2: share of novel blocks from 0 on", "Rule 3: recent variance from 0 on"


def gate_of(run: Path) -> list[str]:
    """Titles in the gate's tab of a run's layout."""
    return [view.name for view in views_of(tabs_of(run)["Gate"])]


def test_the_gate_of_1_0_shows_its_clusters(tmp_path) -> None:
    write_run(tmp_path / "run.mcap", VECTOR, 3, learner={"algorithm": "1.0", "roc_error": 3.0})
    assert gate_of(tmp_path)[1:] == [
        VERDICT,
        "Clustering error by module 1: known below 3",
        "Clustering error by module 2: known below 3",
        "Rule 1: clustering error of the block and its mean, saved below the line",
        *RULES,
    ]


def test_the_gate_of_2_0_shows_its_bands(tmp_path) -> None:
    write_run(tmp_path / "run.mcap", VECTOR, 12)
    shown = gate_of(tmp_path)
    assert any("in the band of 2 SD" in name for name in shown)
    assert not any("Clustering" in name for name in shown)


@pytest.mark.parametrize("algorithm", ["1.0", "2.0"])
def test_the_overview_shows_what_decides_until_a_save(tmp_path, algorithm) -> None:
    write_run(tmp_path / "run.mcap", VECTOR, 3, learner={"algorithm": algorithm, "roc_error": 0.25})
    (rules,) = (view for view in views_of(tabs_of(tmp_path)["Overview"]) if "rules" in view.name)
    assert list(rules.contents) == ["/rules/**"]
