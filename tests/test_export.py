"""Every form gives back the numbers of the log, with what they are."""

from __future__ import annotations

import csv
import json

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from run_data import VECTOR, write_run

from cdmisfa.core.errors import UsageError
from cdmisfa.core.signals import SIGNALS
from replay.export.forms import export


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.setattr("replay.runs.log.BATCH_ITERATIONS", 7)
    return tmp_path, write_run(tmp_path / "run.mcap", VECTOR, 20)


def of_table(path):
    """Values of each signal, what is said of it, and of the run."""
    table = pq.read_table(path)
    values = {name: table.column(name).to_pylist() for name in table.column_names}
    said = {name: table.schema.field(name).metadata for name in values}
    about = {name: {k.decode(): v.decode() for k, v in said[name].items()} for name in values}
    return values, about, table.schema.metadata[b"cdmisfa.manifest"]


def of_arrays(path):
    """The same of NumPy's arrays, which are filled up with NaN."""
    with np.load(path) as arrays:
        assert np.isnan(arrays["band_mean"][0]).all()
        values = {name: arrays[name] for name in arrays.files if not name.startswith("_")}
        return (
            values,
            json.loads(str(arrays["_signals"])),
            json.loads(str(arrays["_run"]))["manifest"],
        )


@pytest.mark.parametrize(("form", "read"), [("parquet", of_table), ("npz", of_arrays)])
def test_every_number_is_there_and_what_it_is(form, read, run):
    folder, records = run
    assert export(folder, folder / f"run.{form}", form) == 20
    values, about, manifest = read(folder / f"run.{form}")
    assert list(values) == list(SIGNALS)
    for name, signal in SIGNALS.items():
        for found, signals in zip(values[name], records, strict=True):
            expected = np.asarray(getattr(signals, name))
            if form == "npz":
                found = found[tuple(slice(size) for size in expected.shape)]
            else:
                found = np.asarray(found, signal.dtype)  # null becomes NaN
            np.testing.assert_array_equal(np.reshape(found, expected.shape), expected)
        assert (about[name]["unit"], about[name]["symbol"]) == (signal.unit, signal.symbol)
    if form != "npz":
        assert about["eta"]["dims"] == SIGNALS["eta"].dims
    assert json.loads(manifest)["config"]["learner"]["tau"] == 40


def test_what_is_missing_is_null_and_nothing_is_nan(run):
    folder, records = run
    export(folder, folder / "run.parquet", "parquet")
    table = pq.read_table(folder / "run.parquet")
    for name, signal in SIGNALS.items():
        column = table.column(name)
        while pa.types.is_list(column.type):
            column = pc.list_flatten(column)
        missing = [np.isnan(getattr(signals, name)).sum() for signals in records]
        assert column.null_count == sum(missing)
        assert signal.dtype != "float64" or not pc.any(pc.is_nan(column)).as_py()


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


def test_an_existing_file_is_kept(run):
    folder, _ = run
    (folder / "run.csv").write_text("mine")
    with pytest.raises(UsageError, match="--force"):
        export(folder, folder / "run.csv", "csv")
    assert (folder / "run.csv").read_text() == "mine"
    export(folder, folder / "run.csv", "csv", force=True)
    with pytest.raises(UsageError, match="xlsx"):
        export(folder, folder / "run.xlsx", "xlsx")
    assert sorted(p.name for p in folder.iterdir()) == ["run.csv", "run.mcap"]
