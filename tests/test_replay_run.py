"""`replay.Run` gives what a run left behind, and reads no more than it is asked for."""

from __future__ import annotations

import json

import numpy as np
import pytest
from run_data import VECTOR, write_run

import replay
from cdmisfa.core.signals import SIGNALS

ITERATIONS = 20


@pytest.fixture
def folder(tmp_path):
    return tmp_path, write_run(tmp_path / "run.mcap", VECTOR, ITERATIONS, saves=True)


def test_signals_are_columns_over_all_iterations(folder):
    path, records = folder
    run = replay.Run(path)
    assert run.streams == VECTOR.streams
    assert set(run.signals) == set(SIGNALS)
    assert "etta" not in run.signals
    for name, signal in SIGNALS.items():
        column = run.signals[name]
        assert (column.dtype, len(column)) == (np.dtype(signal.dtype), ITERATIONS)
        for k, record in enumerate(records):
            expected = np.asarray(getattr(record, name))
            inner = tuple(slice(size) for size in expected.shape)
            np.testing.assert_array_equal(column[k][inner], expected)
            if signal.dims.startswith("M"):
                assert np.isnan(column[k][len(expected) :]).all()


def test_a_run_without_iterations_has_empty_columns(tmp_path):
    write_run(tmp_path / "run.mcap", VECTOR, 0)
    assert replay.Run(tmp_path).signals["y_frozen"].shape == (0, 0, 0, 0)


def test_the_result_is_there_once_the_run_has_ended(folder):
    path, _ = folder
    assert replay.Run(path).result is None
    (path / "run.json").write_text(json.dumps({"result": {"iterations": ITERATIONS}}))
    assert replay.Run(path / "run.mcap").result == {"iterations": ITERATIONS}
    (path / "run.json").write_text("{")
    assert replay.Run(path).result is None


def test_the_packages_hand_it_on():
    import cdmisfa

    assert issubclass(cdmisfa.Run, replay.Run)
    assert {"Run", "RecordedSource"} <= set(dir(replay))
