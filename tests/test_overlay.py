"""Several runs become one table, and one view that holds each one's curves."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from run_data import VECTOR, write_run
from view_data import View, scalars

from cdmisfa.core.errors import UsageError
from replay.runs.compare import first_difference, side_by_side
from replay.view.comparison import build_overlay


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
        result = view.rows[f"/compare/{name}/epsilon"]
        assert result["iteration"] == list(range(12))
        np.testing.assert_array_equal(scalars(result)[:, 0], expected)
        powers = scalars(view.rows[f"/compare/{name}/eta_dot"])[:, 0]
        np.testing.assert_allclose(10**powers, [np.ravel(s.eta_dot)[0] for s in signals])
    with pytest.raises(UsageError, match="--force"):
        build_overlay(runs, side_by_side(runs), out)


def test_the_command_exits_with_4_if_runs_differ(three, tmp_path, cdmisfa):
    (a, b, c), _ = three
    assert cdmisfa("compare", a, b).code == 0
    assert cdmisfa("compare", a, c).code == 4
    done = cdmisfa("compare", a, b, c, "--save", tmp_path / "v.rrd")
    assert done.code == 4
    assert done.out.count("identical, bit for bit") == 1
    assert "iteration 0" in done.out
    assert (tmp_path / "v.rrd").is_file()
    assert cdmisfa("compare", a).code == 2


def test_settings_of_runs_with_the_same_signals_are_compared(tmp_path, cdmisfa):
    runs = [tmp_path / "a", tmp_path / "b"]
    for run, alpha in zip(runs, (0.005, 0.006), strict=True):
        words = ("--max-iterations", 2, "--set", f"learner.alpha={alpha}", "--no-rerun")
        assert cdmisfa("learn", "oscillatory", *words, "-o", run).code == 0
    done = cdmisfa("compare", *runs)
    assert done.code == 0
    settings = "settings changed in b: learner.alpha 0.005 -> 0.006"
    assert done.out == f"identical, bit for bit\n{settings}\n"


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
