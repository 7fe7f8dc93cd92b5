"""Every form gives back the numbers of the log, with what they are."""

from __future__ import annotations

import csv
import json

import numpy as np
import pyarrow as pa
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


def table_of(path):
    if path.suffix == ".parquet":
        return pq.read_table(path)
    with pa.OSFile(str(path)) as file:
        return pa.ipc.open_file(file).read_all()


@pytest.mark.parametrize("form", ["parquet", "arrow"])
def test_tables_hold_every_number_and_what_it_is(form, run):
    folder, records = run
    out = folder / f"run.{form}"
    assert export(folder, out, form) == 20
    table = table_of(out)
    assert table.column_names == list(SIGNALS)
    for name, signal in SIGNALS.items():
        for found, signals in zip(table.column(name).to_pylist(), records, strict=True):
            expected = np.asarray(getattr(signals, name))
            np.testing.assert_array_equal(np.reshape(found, expected.shape), expected)
        about = table.schema.field(name).metadata
        assert about[b"unit"].decode() == signal.unit
        assert about[b"symbol"].decode() == signal.symbol
        assert about[b"dims"].decode() == signal.dims
    manifest = json.loads(table.schema.metadata[b"cdmisfa.manifest"])
    assert manifest["config"]["learner"]["tau"] == 40


def test_npz_holds_every_number(run):
    folder, records = run
    export(folder, folder / "run.npz", "npz")
    with np.load(folder / "run.npz") as arrays:
        assert set(arrays.files) == {*SIGNALS, "_signals", "_run"}
        about = json.loads(str(arrays["_signals"]))
        assert {name: found["unit"] for name, found in about.items()} == {
            name: signal.unit for name, signal in SIGNALS.items()
        }
        assert about["eta"]["symbol"] == SIGNALS["eta"].symbol
        manifest = json.loads(json.loads(str(arrays["_run"]))["manifest"])
        assert manifest["config"]["learner"]["tau"] == 40
        for name in SIGNALS:
            for k, signals in enumerate(records):
                expected = np.asarray(getattr(signals, name))
                stored = arrays[name][k]
                inner = tuple(slice(size) for size in expected.shape)
                np.testing.assert_array_equal(stored[inner], expected)
        assert np.isnan(arrays["band_mean"][0]).all()


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


def test_a_csv_file_comes_with_what_its_columns_are(run):
    folder, _ = run
    export(folder, folder / "run.csv", "csv")
    notes = json.loads((folder / "run.csv-metadata.json").read_text("utf-8"))
    assert notes["url"] == "run.csv"
    with open(folder / "run.csv", newline="") as file:
        titles = next(csv.reader(file))
    columns = notes["tableSchema"]["columns"]
    assert [column["titles"] for column in columns] == titles
    for title, column in zip(titles, columns, strict=True):
        signal = SIGNALS[title.partition("[")[0]]
        assert column["schema:unitText"] == signal.unit
        assert column["schema:alternateName"] == signal.symbol
    signals, run_notes = notes["notes"]
    assert signals["signals"]["eta"]["equation"] == "2"
    assert json.loads(run_notes["run"]["manifest"])["seed"] == 0
    (folder / "run.csv").unlink()
    with pytest.raises(UsageError, match=r"run.csv-metadata.json exists"):
        export(folder, folder / "run.csv", "csv")


def test_an_existing_file_is_kept(run):
    folder, _ = run
    (folder / "run.csv").write_text("mine")
    with pytest.raises(UsageError, match="--force"):
        export(folder, folder / "run.csv", "csv")
    assert (folder / "run.csv").read_text() == "mine"
    export(folder, folder / "run.csv", "csv", force=True)
    with pytest.raises(UsageError, match="xlsx"):
        export(folder, folder / "run.xlsx", "xlsx")
    names = ["run.csv", "run.csv-metadata.json", "run.mcap"]
    assert sorted(p.name for p in folder.iterdir()) == names
