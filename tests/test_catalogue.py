"""A folder of runs is served as one table, on this machine only."""

from __future__ import annotations

import json
import re
import shutil
import signal
import socket

import numpy as np
import pytest
from PIL import Image
from rerun.chunk import Chunk, ChunkStore, RrdReader
from rerun_bindings import CatalogClientInternal
from run_data import VECTOR, write_run
from waiting import started, wait_for

from cdmisfa.core.errors import CdmisfaError, UsageError
from replay.runs.folders import runs_in
from replay.runs.run import read_outline
from replay.view.properties import (
    DIFFERS,
    differing,
    properties_of,
    property_chunks,
    read_properties,
    run_identity,
    write_rows,
)
from replay.viewer.catalogue import (
    LAYER,
    ROWS,
    add_views,
    ready_view,
    serve_catalogue,
    served_table,
    set_layout,
)
from replay.viewer.headless import draw_table, headless_viewer
from replay.viewer.program import missing_driver


@pytest.fixture
def sweep(tmp_path):
    for seed in range(3):
        run = tmp_path / "sweep #1" / f"trial{seed}"
        run.mkdir(parents=True)
        write_run(run / "run.mcap", VECTOR, 6, seed=seed)
    return tmp_path / "sweep #1"


def recording_of(file):
    """Name of the recording in a file."""
    (name,) = (s.recording_id for s in RrdReader(str(file)).recordings())
    return name


def test_runs_are_found_in_a_sweep_and_beside_one_another(sweep):
    assert [run.name for run in runs_in(sweep)] == ["trial0", "trial1", "trial2"]
    assert runs_in(sweep / "trial0") == []
    assert runs_in(sweep / "nothing") == []


def test_rows_and_views_of_a_run_have_one_name_and_say_what_was_run(sweep, tmp_path):
    ready_view(sweep / "trial0")
    shutil.copytree(sweep / "trial0", sweep / "copy of a #1")
    names = set()
    rows = write_rows(runs_in(sweep), tmp_path)
    for run, row in zip(runs_in(sweep), rows, strict=True):
        assert recording_of(row) == recording_of(ready_view(run)) == run_identity(run)
        names.add(recording_of(row))
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
    run = sweep / "trial1"
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
    with pytest.raises(UsageError, match="holds no runs"):
        serve_catalogue(tmp_path)


def test_the_command_serves_every_run_at_its_table_until_interrupted(sweep):
    with started("view", sweep) as process:
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
        assert set(dataset.segment_ids()) == {
            recording_of(run / "run.rrd") for run in runs_in(sweep)
        }
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=20) == 130


@pytest.mark.skipif(bool(missing_driver()), reason=missing_driver())
def test_the_table_of_a_sweep_is_drawn(sweep, tmp_path, monkeypatch):
    monkeypatch.setattr("replay.viewer.headless.SETTLE", 1.0)
    draw_table(sweep, tmp_path / "table.png", window="800x500")
    with Image.open(tmp_path / "table.png") as picture:
        assert picture.size in ((800, 500), (1600, 1000))
        assert len(np.unique(np.asarray(picture.convert("L")))) > 20


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


def test_a_column_of_several_types_keeps_every_cell(sweep, tmp_path, capfd):
    runs, betas = runs_in(sweep), ("auto", 0.5, 2)
    for run, beta, nu in zip(runs, betas, (0.25, 1, 0.5), strict=True):
        manifest(run, beta=beta, nu=nu)
    rows = write_rows(runs, tmp_path)
    assert [cells(row, "beta") for row in rows] == [["auto"], ["0.5"], ["2"]]
    assert [cells(row, "nu") for row in rows] == [[0.25], [1.0], [0.5]]
    # Views were made for themselves, in types of their own.
    for run, beta in zip(runs, betas, strict=True):
        stream = RrdReader(str(ready_view(run))).stream()
        chunks = [c for c in stream if not c.entity_path.startswith("/__properties")]
        chunks += [Chunk(c) for c in property_chunks({"learner": {"beta": beta}})]
        ChunkStore.from_chunks(chunks).write_rrd(
            run / "run.rrd", application_id="cdmisfa", recording_id=run_identity(run)
        )
    with served_table(sweep) as table:
        add_views(runs, table.dataset, tmp_path)
        assert dict(table.dataset.info().layers) == {ROWS: 3, LAYER: 3}
    assert capfd.readouterr().err == ""


@pytest.mark.skipif(bool(missing_driver()), reason=missing_driver())
def test_a_run_opens_in_the_prepared_layout(sweep, tmp_path):
    prepared = {"Events", "Change of weights ξ, as powers of ten"}  # as of one run alone
    with served_table(sweep) as table, headless_viewer("1200x800") as viewer:
        set_layout(table.runs, table.dataset, tmp_path)
        add_views(table.runs, table.dataset, tmp_path)
        url = table.dataset.segment_url(run_identity(table.runs[1]))
        viewer.ask(lambda client: client.open(url) or True)
        viewer.ask(lambda client: prepared <= {view.name for view in client.get_state().views})


def test_a_port_that_another_has_is_refused(sweep):
    with socket.create_server(("", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(CdmisfaError, match=f"--port {port}: Address already in use"):
            serve_catalogue(sweep, port=port)


def test_a_server_that_has_ended_is_not_waited_for(sweep, tmp_path, monkeypatch):
    program = tmp_path / "program"
    program.write_text("#!/bin/sh\necho 'no luck' >&2\nexit 3\n")
    program.chmod(0o755)
    monkeypatch.setattr("replay.viewer.program.viewer_program", lambda: program)
    with pytest.raises(CdmisfaError, match="code 3: no luck"), served_table(sweep) as table:
        assert table is None


def test_a_table_s_first_columns_say_what_differs_and_which_runs_are_identical():
    rows = [
        {"learner": {"nu": nu, "tau": 40}, "result": {"seed": seed, "signals_sha256": sha}}
        for nu, seed, sha in ((0.05, 0, "a"), (0.1, 0, "b"), (0.05, 1, "a"))
    ]
    found = differing(["x", "y", "z"], rows)
    assert found == [
        {"identical_to": "", "learner_nu": 0.05, "seed": 0},
        {"identical_to": "", "learner_nu": 0.1, "seed": 0},
        {"identical_to": "x", "learner_nu": 0.05, "seed": 1},
    ]
    assert min("learner", "result", "scene") > DIFFERS
