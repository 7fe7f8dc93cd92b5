"""A folder of runs is served as one table, on this machine only."""

from __future__ import annotations

import json
import re
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image
from rerun.chunk import Chunk, ChunkStore, RrdReader
from rerun_bindings import CatalogClientInternal
from run_data import VECTOR, write_run
from waiting import wait_for

from cdmisfa.core.errors import CdmisfaError, UsageError
from replay.runs.folders import runs_in
from replay.runs.run import read_outline
from replay.view.properties import (
    properties_of,
    property_chunks,
    read_properties,
    run_identity,
    write_rows,
)
from replay.viewer.catalogue import (
    LAYER,
    ROWS,
    _created,
    _identity,
    _register,
    add_views,
    ready_view,
    serve_catalogue,
    set_layout,
)
from replay.viewer.headless import draw_table, headless_viewer
from replay.viewer.program import free_port, missing_driver, running


@pytest.fixture
def sweep(tmp_path):
    for seed in range(3):
        run = tmp_path / "sweep #1" / "trials" / f"trial{seed}"
        run.mkdir(parents=True)
        write_run(run / "run.mcap", VECTOR, 6, seed=seed)
    return tmp_path / "sweep #1"


def test_runs_are_found_in_a_sweep_and_beside_one_another(sweep):
    assert [run.name for run in runs_in(sweep)] == ["trial0", "trial1", "trial2"]
    assert runs_in(sweep / "trials") == runs_in(sweep)
    assert runs_in(sweep / "trials" / "trial0") == []
    assert runs_in(sweep / "nothing") == []


def test_rows_and_views_of_a_run_have_one_name_and_say_what_was_run(sweep, tmp_path):
    ready_view(sweep / "trials" / "trial0")
    shutil.copytree(sweep / "trials" / "trial0", sweep / "trials" / "copy of a #1")
    names = set()
    rows = write_rows(runs_in(sweep), tmp_path)
    for run, row in zip(runs_in(sweep), rows, strict=True):
        assert _identity(row) == _identity(ready_view(run)) == run_identity(run)
        names.add(_identity(row))
        for file in (row, run / "run.rrd"):
            properties = {
                name
                for chunk in RrdReader(str(file)).stream()
                if chunk.entity_path in ("/__properties/learner", "/__properties/result")
                for name in chunk.to_record_batch().schema.names
            }
            assert {"delta", "tau", "seed", "iterations", "modules"} <= properties
    assert len(names) == 4


def test_the_manifest_of_a_run_says_what_its_log_says(sweep):
    run = sweep / "trials" / "trial1"
    outline = read_outline(run)
    streams, manifest = outline.names(), outline.header.manifest
    result = {
        "iterations": outline.iterations,
        "frames": outline.frames,
        "modules": [{"stream": streams[saved.stream]} for saved in outline.saved],
        "ended": "max_iterations",
        "signals_sha256": "0" * 64,
    }
    document = {"config": manifest["config"], "seed": manifest["seed"], "result": result}
    (run / "run.json").write_text(json.dumps(document), "utf-8")
    assert read_properties(run) == properties_of(outline, run)
    result["modules"] = "?"
    (run / "run.json").write_text(json.dumps(document), "utf-8")
    assert read_properties(run) == properties_of(outline, run)


def test_only_what_is_missing_or_old_is_built(sweep):
    for run in runs_in(sweep):
        ready_view(run)
    before = {run: (run / "run.rrd").stat().st_mtime_ns for run in runs_in(sweep)}
    (runs_in(sweep)[1] / "run.rrd").unlink()
    after = {run: ready_view(run).stat().st_mtime_ns for run in runs_in(sweep)}
    assert [before[run] == after[run] for run in before] == [True, False, True]


def test_a_folder_without_runs_is_refused(tmp_path):
    with pytest.raises(UsageError, match="--keep-logs"):
        serve_catalogue(tmp_path)


def test_the_command_serves_every_run_at_its_table_until_interrupted(sweep):
    process = subprocess.Popen(
        [sys.executable, "-m", "cdmisfa", "view", str(sweep)], stderr=subprocess.PIPE, text=True
    )
    try:
        found = None
        while found is None:
            line = process.stderr.readline()
            assert line, "the command ended"
            found = re.search(r"3 runs at (rerun\+http://127\.[\d.]+:\d+)/entry/(\w+)", line)
        (dataset,) = CatalogClientInternal(found[1]).datasets(include_hidden=False)
        assert str(dataset.entry_details().id) == found[2]
        assert set(dataset.segment_ids()) == {run_identity(run) for run in runs_in(sweep)}
        # the views follow the table
        wait_for(lambda: dict(dataset.info().layers).get(LAYER) == 3, 60, process)
        assert set(dataset.segment_ids()) == {_identity(run / "run.rrd") for run in runs_in(sweep)}
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=20) == 130
    finally:
        process.kill()
        process.communicate()


@pytest.mark.skipif(bool(missing_driver()), reason=missing_driver())
def test_the_table_of_a_sweep_is_drawn(sweep, tmp_path, monkeypatch):
    monkeypatch.setattr("replay.viewer.headless.SETTLE", 1.0)
    draw_table(sweep, tmp_path / "table.png", window="800x500")
    with Image.open(tmp_path / "table.png") as picture:
        assert picture.size in ((800, 500), (1600, 1000))
        assert len(np.unique(np.asarray(picture.convert("L")))) > 20


@pytest.fixture
def dataset():
    """An empty dataset of a server."""
    port = str(free_port())
    with running(["server", "--host", "127.0.0.1", "--port", port]) as server:
        yield _created(f"rerun+http://127.0.0.1:{port}", "runs", server)


def manifest(run, **learner):
    """Give a run a manifest that says this of its learner."""
    document = {
        "config": {"learner": learner},
        "seed": 1,
        "result": {"iterations": 6, "frames": 240, "modules": [], "ended": "max_iterations"},
    }
    (run / "run.json").write_text(json.dumps(document), "utf-8")


def cells(file, name):
    """Values of a property in a recording."""
    return [
        value
        for chunk in RrdReader(str(file)).stream()
        if chunk.entity_path == "/__properties/learner"
        for value in chunk.to_record_batch().column(name).flatten().to_pylist()
    ]


def test_a_column_of_several_types_keeps_every_cell(sweep, tmp_path, dataset, capfd):
    runs = runs_in(sweep)
    for run, beta, nu in zip(runs, ("auto", 0.5, 2), (0.25, 1, 0.5), strict=True):
        manifest(run, beta=beta, nu=nu)
    rows = write_rows(runs, tmp_path)
    assert [cells(row, "beta") for row in rows] == [["auto"], ["0.5"], ["2"]]
    assert [cells(row, "nu") for row in rows] == [[0.25], [1.0], [0.5]]
    assert _register(dataset, rows, ROWS) == {}
    # Views were made for themselves, in types of their own.
    for run, beta in zip(runs, ("auto", 0.5, 2), strict=True):
        stream = RrdReader(str(ready_view(run))).stream()
        chunks = [c for c in stream if not c.entity_path.startswith("/__properties")]
        chunks += [Chunk(c) for c in property_chunks({"learner": {"beta": beta}})]
        ChunkStore.from_chunks(chunks).write_rrd(
            run / "run.rrd", application_id="cdmisfa", recording_id=run_identity(run)
        )
    add_views(runs, dataset, tmp_path)
    assert dict(dataset.info().layers) == {ROWS: 3, LAYER: 3}
    assert capfd.readouterr().err == ""


@pytest.mark.skipif(bool(missing_driver()), reason=missing_driver())
def test_a_run_opens_in_the_prepared_layout(sweep, tmp_path, dataset):
    runs = runs_in(sweep)
    assert _register(dataset, write_rows(runs, tmp_path), ROWS) == {}
    set_layout(runs, dataset, tmp_path)
    add_views(runs, dataset, tmp_path)
    url = dataset.segment_url(run_identity(runs[1]))
    with headless_viewer("1200x800") as viewer:
        viewer.ask(lambda client: client.open(url) or True)
        prepared = {
            "Events",
            "Change of weights ξ, as powers of ten",
        }  # as the views of one run are called
        viewer.ask(lambda client: prepared <= {view.name for view in client.get_state().views})


def served_nothing():
    with running(["server", "--port", "?"]) as server:
        server.wait()
        assert _created(f"rerun+http://127.0.0.1:{free_port()}", "runs", server) is None


def test_a_server_that_has_ended_is_not_waited_for():
    with pytest.raises(CdmisfaError, match="code"):
        served_nothing()
