"""The view does not mislead: how lines are drawn, what their axes hold, what colours mean."""

from __future__ import annotations

import dataclasses
from collections import defaultdict

import numpy as np
import pytest
import rerun as rr
from run_data import IMAGE, PROGRESS, VECTOR, write_run
from view_data import View, views_of

from cdmisfa.core.errors import UsageError
from replay.palette import CYCLE, packed
from replay.runs.run import read_outline
from replay.view.build import build_view
from replay.view.run_layout import run_layout

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
        says = any(word in name.lower() for word in ("slowness", "(gray", "rule", "q of"))
        assert legend is True or len(entities) == 1 or says, name
    assert held >= 4
    assert sum(time["start"] < 0 < time["end"] for _, _, time, *_ in plots if time) >= 2


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
            meaning[rgb].add("mixed" if kind in ("several", "mixed", "switch") else kind)
        for rgb in parts.get("SeriesLines:colors", []):
            named = [s for s in IMAGE.streams if s in " ".join(parts["SeriesLines:names"])]
            has_tab = entity.startswith(("/signals/", "/modules/"))  # a tab names its stream
            assert named or has_tab or rgb not in map(packed, CYCLE), entity
    assert len(meaning) > 5
    assert {rgb: kinds for rgb, kinds in meaning.items() if len(kinds) > 1} == {}
    assert [meaning[packed(rgb)] for rgb in CYCLE[:3]] == [{name} for name in IMAGE.streams]


def test_few_modules_have_a_page_each_and_many_stand_on_pages(tmp_path):
    write_run(tmp_path / "run.mcap", VECTOR, 3)
    for count, pages in (
        (2, ["Module 1", "Module 2"]),
        (14, ["1 to 6", "7 to 12", "13 to 14"]),
        (100, None),
    ):
        outline = dataclasses.replace(read_outline(tmp_path), modules=count)
        layout = run_layout(outline, tab="modules")
        tabs = layout.root_container.contents
        (modules,) = [tab for tab in tabs if tab.name == "Modules"]
        names = [page.name for page in modules.contents]
        assert len(names) == (18 if pages is None else len(pages) + 1)
        assert pages is None or names == [*pages, "Events"]
        shown = [view.origin for view in views_of(modules) if "weights" in str(view.origin)]
        assert shown == [f"/modules/{i}/weights" for i in range(1, count + 1)]
        assert layout.root_container.active_tab == tabs.index(modules)
    with pytest.raises(UsageError, match=r"no tab 'nowhere' .*: choose one of Overview, .*Modules"):
        run_layout(outline, tab="nowhere")
