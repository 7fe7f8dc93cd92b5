"""A folder of runs is served as one table, on this machine only."""

from __future__ import annotations

import re
import shutil
import signal
import subprocess
import sys

import pytest
from rerun.chunk import RrdReader
from rerun_bindings import CatalogClientInternal
from run_data import VECTOR, write_run

from cdmisfa.errors import UsageError
from replay.catalogue import _identity, collect_views, runs_in, serve_catalogue, table_address
from replay.viewer import free_port


@pytest.fixture
def sweep(tmp_path):
    for seed in range(3):
        run = tmp_path / "sweep" / "trials" / f"trial{seed}"
        run.mkdir(parents=True)
        write_run(run / "run.mcap", VECTOR, 6, seed=seed)
    return tmp_path / "sweep"


def test_runs_are_found_in_a_sweep_and_beside_one_another(sweep):
    assert [run.name for run in runs_in(sweep)] == ["trial0", "trial1", "trial2"]
    assert runs_in(sweep / "trials") == runs_in(sweep)
    assert runs_in(sweep / "trials" / "trial0") == []
    assert runs_in(sweep / "nothing") == []


def test_views_have_names_of_their_own_and_say_what_was_run(sweep, tmp_path):
    into = tmp_path / "links"
    into.mkdir()
    collect_views(runs_in(sweep)[:1], into)
    shutil.rmtree(into)
    into.mkdir()
    shutil.copytree(sweep / "trials" / "trial0", sweep / "trials" / "copy")
    names = collect_views(runs_in(sweep), into)
    assert len(set(names)) == 4
    assert len(list(into.glob("*.rrd"))) == 4
    for link in into.iterdir():
        properties = {
            name
            for chunk in RrdReader(str(link)).stream()
            if chunk.entity_path in ("/__properties/learner", "/__properties/result")
            for name in chunk.to_record_batch().schema.names
        }
        assert {"delta", "tau", "seed", "iterations", "modules"} <= properties


def test_only_what_is_missing_or_old_is_built(sweep, tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    collect_views(runs_in(sweep), tmp_path / "a")
    before = {run: (run / "run.rrd").stat().st_mtime_ns for run in runs_in(sweep)}
    (runs_in(sweep)[1] / "run.rrd").unlink()
    seen = []
    collect_views(runs_in(sweep), tmp_path / "b", lambda done, total: seen.append((done, total)))
    after = {run: (run / "run.rrd").stat().st_mtime_ns for run in runs_in(sweep)}
    assert [before[run] == after[run] for run in before] == [True, False, True]
    assert seen == [(1, 3), (2, 3), (3, 3)]


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
        names = {_identity(run / "run.rrd") for run in runs_in(sweep)}
        assert set(dataset.segment_ids()) == names
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=20) == 130
    finally:
        process.kill()
        process.communicate()


def test_a_server_that_does_not_answer_is_named_all_the_same():
    address = f"rerun+http://127.0.0.1:{free_port()}"
    assert table_address(address, 1, seconds=0.3) == address
