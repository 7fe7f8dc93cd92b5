"""A folder of runs is served as one table, on this machine only."""

from __future__ import annotations

import json
import re
import shutil
import signal
import subprocess
import sys
import time

import pytest
from rerun.chunk import RrdReader
from rerun_bindings import CatalogClientInternal
from run_data import VECTOR, write_run

from cdmisfa.errors import UsageError
from replay.catalogue import (
    LAYER,
    _identity,
    ready_view,
    runs_in,
    serve_catalogue,
    table_address,
)
from replay.outline import read_outline
from replay.properties import properties_of, read_properties, run_identity, write_row
from replay.viewer import free_port


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
    for i, run in enumerate(runs_in(sweep)):
        row = tmp_path / f"{i}.rrd"
        write_row(run, row)
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
            found = re.search(r"3 runs at (rerun\+http://127\.0\.0\.1:\d+)/entry/(\w+)", line)
        (dataset,) = CatalogClientInternal(found[1]).datasets(include_hidden=False)
        assert str(dataset.entry_details().id) == found[2]
        assert set(dataset.segment_ids()) == {run_identity(run) for run in runs_in(sweep)}
        end = time.monotonic() + 60
        while dict(dataset.info().layers).get(LAYER) != 3:  # the views follow the table
            assert time.monotonic() < end
            time.sleep(0.05)
        assert set(dataset.segment_ids()) == {_identity(run / "run.rrd") for run in runs_in(sweep)}
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=20) == 130
    finally:
        process.kill()
        process.communicate()


def test_a_server_that_does_not_answer_is_named_all_the_same():
    address = f"rerun+http://127.0.0.1:{free_port()}"
    assert table_address(address, 1, seconds=0.3) == address
