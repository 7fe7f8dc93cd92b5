"""Two runs are the same to the last bit, or the first difference is named."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from run_data import VECTOR, having, run_of, write_run

from replay.runs.compare import first_difference
from replay.runs.writer import RunWriter


def write_changed(path, iteration, name, change):
    def edit(signals):
        if signals.iteration != iteration:
            return signals
        return dataclasses.replace(signals, **{name: change(np.array(getattr(signals, name)))})

    write_run(path, VECTOR, 8, seed=3, edit=edit)


def test_equal_runs_have_no_difference(tmp_path):
    for name in ("a", "b"):
        write_run(tmp_path / name, VECTOR, 8, seed=3)
    assert first_difference(tmp_path / "a", tmp_path / "b") is None


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


def test_one_nan_is_as_good_as_another(tmp_path):
    write_run(tmp_path / "a", VECTOR, 8, seed=3)
    write_changed(tmp_path / "b", 5, "reward", other_nan)
    assert first_difference(tmp_path / "a", tmp_path / "b") is None


def test_a_run_that_ended_early_is_said_so(tmp_path):
    write_run(tmp_path / "a", VECTOR, 8, seed=3)
    writer = RunWriter(tmp_path / "b", VECTOR, {})
    for signals, block in list(run_of(VECTOR, 8, seed=3))[:6]:
        writer.block(block, signals, having(np.zeros((1, 2))))
    writer.finish()
    difference = first_difference(tmp_path / "a", tmp_path / "b")
    assert str(difference) == "iteration 6: the first goes on, the second ended after 6 iterations"
