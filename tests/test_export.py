"""Signals of a run and numbers of logs as tables, with every number of the log."""

from __future__ import annotations

import csv
import json

import numpy as np
import pyarrow.csv
import pyarrow.parquet as pq
import pytest
from camera_files import pictures, write_images
from message_files import write_mcap
from run_data import VECTOR, write_run

from cdmisfa.core.errors import UsageError
from cdmisfa.core.signals import SIGNALS
from recorder.images.messages import MessageKind
from replay.export.formats import export
from replay.open_sources import open_recording


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


JOINTS = MessageKind("JointState", "json")


def joint_log(path, topics=("/joints",), count=9000):
    """A log with uneven times, each topic with half the messages of the one before."""
    times = 10**18 + np.cumsum(np.random.default_rng(0).integers(1, 10**8, count))
    rows = [{"position": [i / 7, -i], "velocity": [i % 3], "effort": []} for i in range(count)]
    messages = [(int(t), json.dumps(row).encode()) for t, row in zip(times, rows, strict=True)]
    write_mcap(path, JOINTS, {name: messages[:: 2**i] for i, name in enumerate(topics)})
    return times, np.array([[*row["position"], *row["velocity"]] for row in rows])


@pytest.mark.parametrize("form", ["parquet", "csv"])
def test_numbers_of_a_topic_are_a_row_a_message_at_its_time(tmp_path, cdmisfa, form):
    times, numbers = joint_log(tmp_path / "log.mcap")
    out = tmp_path / f"joints.{form}"
    words = ("--topic", "/joints", "--field", "position", "--field", "velocity[0:]")
    assert (
        cdmisfa("export", tmp_path / "log.mcap", *words, "-o", out, "--json").json["rows"] == 9000
    )
    table = pq.read_table(out) if form == "parquet" else pyarrow.csv.read_csv(out)
    assert table.column_names == ["log_time", "position[0]", "position[1]", "velocity[0]"]
    np.testing.assert_array_equal(table["log_time"], times)
    np.testing.assert_array_equal(np.transpose(table.columns[1:]), numbers)
    timed = ("--set", "input.time=log_time:ns", "-o", tmp_path / "again.csv")
    assert cdmisfa("export", out, *timed).code == 0
    again = pyarrow.csv.read_csv(tmp_path / "again.csv")
    assert again.to_pydict() == table.to_pydict()


def test_several_topics_and_recordings_of_numbers_are_a_table_a_stream(tmp_path, cdmisfa):
    log, rec = tmp_path / "log.mcap", tmp_path / "rec"
    times, numbers = joint_log(log, ("/a", "/b"), 60)
    assert (
        "choose a folder"
        in cdmisfa("export", log, "--topic", "/a", "--topic", "/b", "-o", tmp_path / "x.csv").err
    )
    done = cdmisfa("export", log, "--topic", "/a", "--topic", "/b", "--to", "parquet", "-o", rec)
    assert "read as its numbers position, velocity" in done.err
    for i, name in enumerate("ab"):
        table = pq.read_table(rec / f"{name}.parquet")
        np.testing.assert_array_equal(table["log_time"], times[:: 2**i])
        np.testing.assert_array_equal(np.transpose(table.columns[1:]), numbers[:: 2**i])
    how = ("--topic", "/a", "--field", "position", "--align", "time", "--rate", "10")
    assert cdmisfa("convert", log, *how, "-o", rec, "--force").code == 0
    assert cdmisfa("export", rec, "-o", tmp_path / "rec.parquet").code == 0
    with open_recording(rec) as source:
        table, frames = pq.read_table(tmp_path / "rec.parquet"), source.take(0, source.frames)
        assert table["log_time"].to_pylist() == source.spec.times(0, source.frames).tolist()
        np.testing.assert_array_equal(np.transpose(table.columns[1:]), frames.frames)


def test_a_table_says_what_it_rounds_and_refuses_what_has_no_columns(tmp_path, cdmisfa):
    values = [{"n": 2**53 + i, "list": [1] * (1 + i % 2)} for i in range(4)]
    messages = [(10**18 + i * 10**7, json.dumps(row).encode()) for i, row in enumerate(values)]
    write_mcap(tmp_path / "n.mcap", JOINTS, {"/n": messages})
    export_ = ("export", tmp_path / "n.mcap", "-o", tmp_path / "n.parquet", "--field")
    (line,) = cdmisfa(*export_, "n", "--json").json["warnings"]
    assert line.endswith("numbers above 2^53 may be rounded to float64")
    refused = cdmisfa(*export_, "list", "--force")
    assert (refused.code, "has 2 numbers, but the first had 1" in refused.err) == (2, True)
    write_images(tmp_path / "cam.mcap", {"/cam": [(i * 20, x) for i, x in enumerate(pictures(5))]})
    refused = cdmisfa("export", tmp_path / "cam.mcap", "-o", tmp_path / "c.csv")
    assert "cam has images: choose numbers with --field" in refused.err
