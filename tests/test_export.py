"""A run's signals as Parquet, npz and CSV hold the numbers of its log and their metadata."""

from __future__ import annotations

import csv
import json

import numpy as np
import pyarrow.parquet as pq
import pytest
from run_data import VECTOR, write_run

from cdmisfa.core.errors import UsageError
from cdmisfa.core.signals import SIGNALS
from replay.export.formats import export


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.setattr("replay.runs.log.BATCH_ITERATIONS", 7)
    return tmp_path, write_run(tmp_path / "run.mcap", VECTOR, 20)


def read_parquet(path):
    """Return values and metadata of each signal, and the manifest of the run."""
    table = pq.read_table(path)
    values = {name: table.column(name).to_pylist() for name in table.column_names}
    fields = {name: table.schema.field(name).metadata for name in values}
    facts = {name: {k.decode(): v.decode() for k, v in fields[name].items()} for name in values}
    return values, facts, table.schema.metadata[b"cdmisfa.manifest"]


def read_npz(path):
    with np.load(path) as arrays:
        assert np.isnan(arrays["band_mean"][0]).all()  # no module yet
        values = {name: arrays[name] for name in arrays.files if not name.startswith("_")}
        facts, run = (json.loads(str(arrays[name])) for name in ("_signals", "_run"))
        return values, facts, run["manifest"]


@pytest.mark.parametrize(("form", "read"), [("parquet", read_parquet), ("npz", read_npz)])
def test_a_file_holds_every_number_and_its_metadata(form, read, run):
    folder, records = run
    assert export(folder, folder / f"run.{form}", form) == 20
    values, facts, manifest = read(folder / f"run.{form}")
    assert list(values) == list(SIGNALS)
    for name, signal in SIGNALS.items():
        for value, signals in zip(values[name], records, strict=True):
            expected = np.asarray(getattr(signals, name))
            if form == "npz":
                value = value[tuple(slice(size) for size in expected.shape)]
            value = np.asarray(value, signal.dtype)  # null becomes NaN
            np.testing.assert_array_equal(np.reshape(value, expected.shape), expected)
        assert [facts[name][key] for key in ("unit", "symbol", "dims")] == [
            signal.unit,
            signal.symbol,
            signal.dims,
        ]
    assert json.loads(manifest)["config"]["learner"]["tau"] == 40


def test_csv_reads_back_exactly(run):
    folder, records = run
    export(folder, folder / "run.csv", "csv")
    with open(folder / "run.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 20
    for row, signals in zip(rows, records, strict=True):
        assert float(row["epsilon"]) == signals.epsilon
        assert int(row["stream"]) == signals.stream
        assert float(row["Q[2,1]"]) == signals.Q[2, 1]
        assert row["novel"] == str(signals.novel)
    assert float(rows[-1]["band_mean[1,0]"]) == 0.01
    assert rows[0]["band_mean[1,0]"] == "nan"


def test_an_existing_file_is_replaced_only_by_force(run):
    folder, _ = run
    (folder / "run.csv").write_text("mine")
    with pytest.raises(UsageError, match="--force"):
        export(folder, folder / "run.csv", "csv")
    with pytest.raises(UsageError, match="one run: give one run"):
        export([folder, folder], folder / "two.csv", "csv")
    assert (folder / "run.csv").read_text() == "mine"
    assert export(folder, folder / "run.csv", "csv", force=True) == 20
