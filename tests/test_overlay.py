"""Several runs become one table, and one view that holds each one's curves."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from run_data import VECTOR, having, run_of, write_run
from view_data import View, scalars, views_of

from cdmisfa.core.errors import UsageError
from replay.runs.compare import first_difference, side_by_side
from replay.runs.writer import RunWriter
from replay.view import overlay
from replay.view.overlay import build_overlay


@pytest.fixture
def three(tmp_path):
    """Two equal runs of the same name in other places, and another one."""
    runs = [tmp_path / "a" / "run", tmp_path / "b" / "run", tmp_path / "c"]
    records = []
    for run, seed in zip(runs, (3, 3, 4), strict=True):
        run.mkdir(parents=True)
        records.append(write_run(run / "run.mcap", VECTOR, 12, seed=seed, saves=True))
    return runs, records


def test_the_table_says_which_runs_are_the_first_ones_equals(three):
    runs, _ = three
    first, equal, other = side_by_side(runs)
    assert first.difference is None
    assert equal.difference is None
    assert other.difference.iteration == 0
    row = other.as_json()
    assert (row["run"], row["iterations"], len(row["modules"])) == ("c", 12, 3)


def test_the_view_holds_each_runs_values(three, tmp_path):
    runs, records = three
    out = tmp_path / "all.rrd"
    build_overlay(runs, side_by_side(runs), out)
    view = View(out)
    assert len(view.blueprints) == 1
    for name, signals in zip((r"1_a\/run", r"2_b\/run", "3_c"), records, strict=True):
        expected = [s.epsilon for s in signals]
        found = view.rows[f"/compare/{name}/epsilon"]
        assert found["iteration"] == list(range(12))
        np.testing.assert_array_equal(scalars(found)[:, 0], expected)
        powers = scalars(view.rows[f"/compare/{name}/eta_dot"])[:, 0]
        np.testing.assert_allclose(10**powers, [np.ravel(s.eta_dot)[0] for s in signals])
    with pytest.raises(UsageError, match="--force"):
        build_overlay(runs, side_by_side(runs), out)
    with pytest.raises(UsageError, match="no tab 'nowhere'"):
        build_overlay(runs, side_by_side(runs), out, force=True, tab="nowhere")


def test_curves_that_no_run_tells_have_no_panel(tmp_path, monkeypatch):
    def tell_errors_alone(signals):
        none = {name: np.full(np.shape(getattr(signals, name)), np.nan) for name in ("eta_dot",)}
        return dataclasses.replace(signals, **none, share=np.nan, R=np.empty((0, 2, 0)))

    written = write_run(tmp_path / "run.mcap", VECTOR, 12, edit=tell_errors_alone)
    tabs = []

    def take(*found, **_):
        tabs.extend(found)
        return blueprint(*found, name="Comparison")

    blueprint = overlay.blueprint
    monkeypatch.setattr(overlay, "blueprint", take)
    out = tmp_path / "all.rrd"
    build_overlay([tmp_path], side_by_side([tmp_path]), out)
    assert [tab.name for tab in tabs] == ["Overview", "Streams"]
    names = [view.name for view in tabs[0].contents[1].contents]
    assert names == [overlay.CURVES[n] for n in ("epsilon", "eta", "tested")]
    views = [view for tab in tabs for view in views_of(tab)]
    assert len({id(view) for view in views}) == len(views)  # a view has one place
    found = View(out).rows
    for view in views:
        assert all(entity in found for entity in view.contents if isinstance(view.contents, list))
    name = tmp_path.name
    own = [s.iteration for s in written if s.stream == 1]
    curve = found[f"/compare/1_{name}/learning_error/2_x2"]
    assert own == [0, 2, 9]
    assert curve["iteration"] == [0, 2, 2, 9, 9]  # it ends where another stream is watched
    assert np.isnan(scalars(curve)).ravel().tolist() == [False, True, False, True, False]


def test_the_command_exits_with_4_only_for_two_that_differ(three, tmp_path, cdmisfa):
    (a, b, c), _ = three
    assert cdmisfa("compare", a, b).code == 0
    assert cdmisfa("compare", a, c).code == 4
    done = cdmisfa("compare", a, b, c, "--save", tmp_path / "v.rrd")
    assert done.code == 0
    assert done.out.count("identical, bit for bit") == 1
    assert "iteration 0" in done.out
    assert (tmp_path / "v.rrd").is_file()
    assert cdmisfa("compare", a).code == 2


def write_changed(path, iteration, name, change):
    def edit(signals):
        if signals.iteration != iteration:
            return signals
        return dataclasses.replace(signals, **{name: change(np.array(getattr(signals, name)))})

    write_run(path, VECTOR, 8, seed=3, edit=edit)


def one_bit(value):
    value.reshape(-1).view(np.uint64)[-1] ^= 1
    return value


def other_nan(value):
    value[...] = np.array(0xFFF8_0000_0000_0001, dtype=np.uint64).view(np.float64)
    return value


@pytest.mark.parametrize(
    ("name", "change", "place"),
    [
        ("y", one_bit, (39, 0)),
        ("Q", one_bit, (2, 1)),
        ("epsilon", one_bit, ()),
        ("stream", lambda v: (v + 1) % 3, ()),
        ("novel", lambda v: not v, ()),
    ],
)
def test_the_first_difference_is_named(name, change, place, tmp_path):
    write_run(tmp_path / "a", VECTOR, 8, seed=3)
    write_changed(tmp_path / "b", 5, name, change)
    difference = first_difference(tmp_path / "a", tmp_path / "b")
    assert (difference.iteration, difference.signal, difference.place) == (5, name, place)
    assert str(difference).startswith(f"iteration 5: {name}")


@pytest.mark.parametrize("change", [lambda value: value, other_nan])
def test_equal_runs_have_no_difference_and_one_nan_is_as_good_as_another(tmp_path, change):
    write_run(tmp_path / "a", VECTOR, 8, seed=3)
    write_changed(tmp_path / "b", 5, "reward", change)
    assert first_difference(tmp_path / "a", tmp_path / "b") is None


def test_a_run_that_ended_early_is_said_so(tmp_path):
    write_run(tmp_path / "a", VECTOR, 8, seed=3)
    writer = RunWriter(tmp_path / "b", VECTOR, {})
    for signals, block in list(run_of(VECTOR, 8, seed=3))[:6]:
        writer.block(block, signals, having(np.zeros((1, 2))))
    writer.close()
    difference = first_difference(tmp_path / "a", tmp_path / "b")
    assert (
        str(difference) == "iteration 6: the first continues, the second ended after 6 iterations"
    )
