"""Modules are applied to each of many logs once, whoever does it and whatever dies meanwhile."""

from __future__ import annotations

import contextlib
import resource
import shutil
import signal
import socket
import subprocess
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from applied_data import camera, make_run
from camera_files import pictures
from conftest import Cdmisfa
from engine_tasks import apply_or_die
from waiting import listens, running, started, wait_for

from cdmisfa import Run
from cdmisfa.core.processes import WorkersError
from cdmisfa.experiments import apply_logs as applying
from cdmisfa.experiments import store
from cdmisfa.experiments.apply_logs import STORE, AppliedLogs, apply_to_logs
from recorder.recording import record
from replay.open_sources import open_arrays

ROOT = Path(__file__).parents[1]
NAMES = ["a.mcap", "night/b.mcap", "night/c.mcap", "night/copy.mcap"]


@pytest.fixture
def run(cdmisfa: Cdmisfa, tmp_path: Path) -> Path:
    """See `make_run`."""
    return make_run(cdmisfa, tmp_path)


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    """A folder with four logs, of which two are alike, beneath one another."""
    folder = tmp_path / "logs"
    (folder / "night").mkdir(parents=True)
    for seed, name in enumerate(NAMES[:3]):
        camera(folder / name, 90, seed)
    shutil.copyfile(folder / "night" / "c.mcap", folder / "night" / "copy.mcap")
    return folder


def files(out: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in out.iterdir() if path.name != STORE}


def applied_now(found: AppliedLogs) -> tuple[int, int]:
    return found.computed, found.skipped


def y(table: Any, log: str) -> np.ndarray:
    own = table.filter(np.array(table["log"].to_pylist()) == log)
    return np.stack([own[f"module1_y{j}"].to_numpy() for j in range(3)], axis=1)


def test_a_folder_of_logs_becomes_one_table(
    run: Path, logs: Path, cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    shown = np.stack(list(pictures(50)))
    record(open_arrays({"cam": shown, "other": shown[::-1].copy()}), logs / "rec")
    shutil.copytree(run, logs / "learned")
    (logs / "broken.mcap").write_bytes(b"nothing")
    (logs / "unlike.csv").write_text("x\n1\n2\n")
    out = tmp_path / "out"
    done = cdmisfa("apply", run, logs, "-o", out, "--json")
    assert done.code == 3, done.err
    said = {row["log"]: row for row in done.json["logs"]}
    assert sorted(said) == sorted([*NAMES, "broken.mcap", "rec", "unlike.csv"])
    assert [name for name, row in said.items() if row["error"]] == ["broken.mcap", "unlike.csv"]
    table = pq.read_table(out)
    assert set(table["log"].to_pylist()) == {*NAMES, "rec"}
    module = Run(run).modules[0]
    for seed, name in enumerate([*NAMES[:3], NAMES[2]]):
        expected = module.transform(np.stack(list(pictures(90, [0, 1, 2, 2][seed]))))
        np.testing.assert_array_equal(y(table, NAMES[seed]), expected)
        assert pq.read_table(said[name]["out"]).num_rows == said[name]["frames"] == 90
    rows = zip(table["log"].to_pylist(), table["stream"].to_pylist(), strict=True)
    recorded = {("rec", "cam"): 50, ("rec", "other"): 50}
    assert Counter(rows) == {(name, "cam"): 90 for name in NAMES} | recorded
    done = cdmisfa("apply", run, logs, "-o", out)
    assert done.code == 3
    assert "7 processed before; of all, 2 failed, 0 incomplete, 0 with warnings" in done.out
    assert "failed: broken.mcap: " in done.out


def test_the_same_bytes_come_of_processes_and_of_dask_though_a_worker_is_killed(
    run: Path, logs: Path, tmp_path: Path, cluster: tuple[str, list[subprocess.Popen[bytes]]]
) -> None:
    for seed in range(8):
        camera(logs / f"more-{seed}.mcap", 300, seed)
    apply_to_logs(run, [str(logs)], tmp_path / "here")
    there = apply_to_logs(run, [str(logs)], tmp_path / "two", jobs=2)
    assert (applied_now(there), there.failed) == ((12, 0), [])
    address, workers = cluster
    far = apply_to_logs(
        run, [str(logs)], tmp_path / "far", scheduler=address, progress=lambda *_: workers[0].kill()
    )
    assert workers[0].wait() == -signal.SIGKILL
    assert (applied_now(far), far.failed) == ((12, 0), [])
    assert files(tmp_path / "here") == files(tmp_path / "two") == files(tmp_path / "far")


def test_a_log_that_kills_its_worker_ends_the_work_and_the_rest_is_kept(
    run: Path, logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    deadly = camera(logs / "zz-deadly.mcap", 30)
    with monkeypatch.context() as patched:
        patched.setattr(applying, "apply_to_log", apply_or_die)
        with pytest.raises(WorkersError, match="run again to do the rest"):
            apply_to_logs(run, [str(logs)], tmp_path / "out", jobs=2)
    assert Path(f"{deadly}.deaths").read_text() == "."
    before = files(tmp_path / "out")
    again = apply_to_logs(run, [str(logs)], tmp_path / "out", jobs=2)
    assert again.failed == []
    assert before.items() <= files(tmp_path / "out").items()
    assert len(files(tmp_path / "out")) == 5


def test_only_what_is_missing_or_has_changed_is_done(
    run: Path, logs: Path, cdmisfa: Cdmisfa, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"

    def again(*words: Path, **how: Any) -> tuple[int, int]:
        return applied_now(apply_to_logs(run, [str(w) for w in words or (logs,)], out, **how))

    assert again() == (4, 0)
    whole = files(out)
    assert again() == (0, 4)
    monkeypatch.chdir(logs)
    assert again(Path("night"), Path("*.mcap")) == (0, 4)
    assert cdmisfa("index", logs).code == 0
    assert again(logs / "corpus.parquet") == (0, 4)
    camera(logs / "d.mcap", 40)
    assert again() == (1, 4)
    (out / "d.mcap.parquet").unlink()
    assert again() == (1, 4)

    before = (logs / "a.mcap").stat()
    copy = shutil.copy2(logs / "a.mcap", tmp_path / "kept.mcap")
    camera(logs / "a.mcap", 60, 5)
    assert again() == (1, 4)
    assert files(out)["a.mcap.parquet"] != whole["a.mcap.parquet"]
    shutil.copy2(copy, logs / "a.mcap")
    assert (logs / "a.mcap").stat().st_mtime_ns == before.st_mtime_ns
    assert again() == (1, 4)
    assert files(out)["a.mcap.parquet"] == whole["a.mcap.parquet"]

    monkeypatch.setattr(store, "code", lambda *more: "0.0+other")
    assert again() == (5, 0)


def test_other_outputs_are_replaced_only_by_force(
    run: Path, logs: Path, cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    words = ("apply", run, logs, "-o", out)
    assert cdmisfa(*words).code == 0
    refused = cdmisfa(*words, "--frames", 30)
    assert (refused.code, refused.err.count("\n")) == (2, 1)
    assert "holds outputs of other options: choose another folder, or" in refused.err
    (logs / "a.mcap").unlink()
    (out / "notes.csv").write_text("mine")
    forced = cdmisfa(*words, "--frames", 30, "--force", "--to", "csv")
    assert forced.code == 0, forced.err
    assert files(out).pop("notes.csv") == b"mine"
    assert sorted(name.rpartition(".")[2] for name in files(out)) == ["csv"] * 4
    shutil.copytree(run, tmp_path / "moved")
    moved = cdmisfa("apply", tmp_path / "moved", logs, "-o", out, "--frames", 30, "--to", "csv")
    assert "3 logs: 0 processed now, 3 processed before" in moved.out
    other = Run(run).modules
    from replay.runs.modules import save_modules

    save_modules(run / "modules.npz", other[:1])
    refused = cdmisfa(*words, "--frames", 30, "--to", "csv")
    assert "holds outputs of other modules" in refused.err
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "x.txt").write_text("mine")
    refused = cdmisfa("apply", run, logs, "-o", tmp_path / "mine")
    assert (refused.code, "mine exists: choose another folder" in refused.err) == (2, True)


def test_what_is_finished_is_kept_when_it_is_stopped(run: Path, logs: Path, tmp_path: Path) -> None:
    for seed in range(60):
        shutil.copyfile(logs / "a.mcap", logs / f"more-{seed}.mcap")
    out = tmp_path / "out"
    with started("apply", run, logs, "-o", out, "--jobs", 2) as process:
        wait_for(lambda: len(list(out.glob("*.parquet"))) >= 3, seconds=100)
        process.terminate()
        complaint = process.communicate(timeout=30)[1]
    assert process.returncode == 143
    assert complaint.splitlines()[-1] == (
        f"cdmisfa: interrupted: finished results are in {out}: run the same command again"
    )
    done = len(files(out))
    assert pq.read_table(out).num_rows == 90 * done
    assert not (out / STORE / "parts").exists()
    result = apply_to_logs(run, [str(logs)], out)
    assert done - 2 <= result.skipped <= done < 64 == len(files(out))


def test_a_full_disk_is_a_line_and_the_files_before_are_kept(
    run: Path, logs: Path, cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    for name in NAMES[1:]:
        (logs / name).unlink()
    camera(logs / "long.mcap", 4000)
    out = tmp_path / "out"
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, hard))
    try:
        done = cdmisfa("apply", run, logs, "-o", out)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (done.code, done.err.count("\n")) == (1, 1), done.err
    assert "long.mcap.parquet cannot be written: " in done.err
    assert "File too large" in done.err
    assert list(files(out)) == ["a.mcap.parquet"]
    assert "1 processed now, 1 processed before" in cdmisfa("apply", run, logs, "-o", out).out


def test_odd_names_are_as_they_were_in_the_table(run: Path, logs: Path, tmp_path: Path) -> None:
    odd = ["_hidden", ".dot", "1", "-x", "a=b", "x y", "schön", "夜" * 60]
    odd += ["a.b", "A.b", "%2F", "a/b"]
    for name in odd:
        (logs / name).parent.mkdir(exist_ok=True)
        shutil.copyfile(logs / "a.mcap", logs / f"{name}.mcap")
    apply_to_logs(run, [str(logs)], tmp_path / "out")
    table = pq.read_table(tmp_path / "out")
    assert set(table["log"].to_pylist()) == {*NAMES, *(f"{name}.mcap" for name in odd)}
    assert table.num_rows == 90 * (len(NAMES) + len(odd))


def test_a_log_damaged_half_way_is_named_each_time(
    run: Path, logs: Path, cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    log = camera(logs / "half.mcap", 3000)
    data = bytearray(log.read_bytes())
    half = len(data) // 2
    data[half : half + 40] = bytes(40)
    log.write_bytes(data)
    for now in (5, 0):
        done = cdmisfa("apply", run, logs, "-o", tmp_path / "out", "--json")
        assert (done.code, done.json["computed"]) == (3, now)
        (row,) = (row for row in done.json["logs"] if row["error"])
        assert (row["log"], 1000 < row["frames"] < 2000) == ("half.mcap", True)
        table = pq.read_table(row["out"])
        shown = np.stack(list(pictures(row["frames"])))
        np.testing.assert_array_equal(y(table, "half.mcap"), Run(run).modules[0].transform(shown))
    assert cdmisfa("apply", run, log, "-o", tmp_path / "w.csv", "--skip-damaged").code == 0


def test_views_of_one_recording_one_after_the_other_keep_their_outputs(
    run: Path, cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    shown = np.stack(list(pictures(50)))
    record(open_arrays({"cam": shown, "other": shown[::-1].copy()}), tmp_path / "rec")
    for view in ("cam", "other"):
        done = cdmisfa("apply", run, tmp_path / "rec" / f"{view}.mcap", "-o", tmp_path / "out")
        assert done.code == 0, done.err
    assert set(files(tmp_path / "out")) == {"cam.mcap.parquet", "other.mcap.parquet"}


def test_the_summary_names_logs_that_were_cut_short(
    run: Path, logs: Path, cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    log = camera(logs / "cut.mcap", 3000)
    log.write_bytes(log.read_bytes()[: log.stat().st_size * 2 // 3])
    done = cdmisfa("apply", run, logs, "-o", tmp_path / "out")
    assert (done.code, "0 failed, 0 incomplete, 1 with warnings" in done.out) == (0, True)
    assert "cut.mcap: " in done.err
    done = cdmisfa("apply", run, log)
    assert done.code == 0
    assert done.out.splitlines()[0].endswith(" frames in all streams, 1 warning")
    (row,) = cdmisfa("apply", run, log, "--json").json["logs"]
    assert "cut short" in row["warnings"][0]


def test_workers_of_a_dask_cluster_apply_and_sweep(
    run: Path, cdmisfa: Cdmisfa, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = str(free.getsockname()[1])
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sample_logs").symlink_to(ROOT / "sample_logs")
    (tmp_path / "runs").mkdir()
    run.rename("runs/cameras")
    address = f"tcp://127.0.0.1:{port}"
    with contextlib.ExitStack() as ended:
        for words in (
            f"scheduler --host 127.0.0.1 --port {port}",
            f"worker {address} --nthreads 1 --nworkers 2",
        ):
            ended.enter_context(running("-m", "dask", *words.split(), "--no-dashboard"))
        wait_for(lambda: listens(int(port)), seconds=60)
        for words in (
            "apply runs/cameras sample_logs/ic* -o applied/there",
            "sweep oscillatory --seeds 0:2 --max-modules 1 -o sweeps/there",
        ):
            done = cdmisfa(*words.split(), "--scheduler", address)
            assert done.code == 0, done.err
    assert pq.read_table("applied/there")["log"].unique().to_pylist() == ["icub"]
