"""Sweeps compute every trial once, whoever computes it and whatever dies meanwhile."""

from __future__ import annotations

import contextlib
import csv
import json
import os
import re
import signal
import subprocess
import threading
from pathlib import Path
from typing import Any

import click
import psutil
import pytest
from camera_files import write_cameras
from conftest import Cdmisfa
from waiting import running, started, wait_for

from cdmisfa.cli.commands.trials import parse_grid, parse_seeds
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.errors import LogDamagedError
from cdmisfa.core.processes import WorkersError
from cdmisfa.experiments import results as reading
from cdmisfa.experiments import store
from cdmisfa.experiments import sweep as sweeping
from cdmisfa.experiments.session import run_session
from cdmisfa.experiments.store import ROWS, read_trial_rows
from cdmisfa.experiments.sweep import DROPPED_KEYS, plan, sweep
from recorder.recording import record_scene
from recorder.world.oscillatory import OscillatorySource

LEFT = ("--topic", "/left", "--size", "8x8")
GRID = {"learner.sigma": [0, 0.0009]}


def rows_of(folder: Path) -> dict[str, Any]:
    """Rows by trial, without where the logs are."""
    return {
        row["id"]: {k: v for k, v in row.items() if k != "run"} for row in read_trial_rows(folder)
    }


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Rows of a sweep in this process."""
    folder = tmp_path_factory.mktemp("local")
    report = sweep("oscillatory", folder, grid=GRID, seeds=range(8))
    assert (report.trials, report.computed, report.failed) == (16, 16, ())
    return rows_of(folder)


# Trials and their identity


def test_a_trial_is_named_by_what_it_depends_on(monkeypatch: pytest.MonkeyPatch) -> None:
    def number(**more: Any) -> str:
        (trial,) = plan("oscillatory", **{"grid": {}, "seeds": [0]} | more)
        return trial.id

    assert number() == number() == number(settings=["learner.nu=0.05"])
    assert number() == number(settings=["scene.seed=0"])  # the world has the seed of the trial
    others = {
        number(seeds=[1]),
        number(settings=["learner.nu=0.06"]),
        number(grid={"learner.nu": [0.07]}),
        number(settings=["scene.streams=x1,x2"]),
        number(max_iterations=10),
    }
    monkeypatch.setattr(store, "code", lambda *more: "0.0.0+another")
    others.add(number())
    assert len(others | {number(max_modules=1)}) == 7


def test_a_recording_is_named_by_its_bytes_and_swept_as_its_scene_is(tmp_path: Path) -> None:
    for name, frames in (("a", 3000), ("b", 3000), ("c", 300)):
        record_scene("oscillatory", tmp_path / name, frames=frames)
    a, b, c = (plan(tmp_path / n, grid={}, seeds=[0])[0] for n in ("a", "b", "c"))
    assert a.id == b.id != c.id
    result = []
    for source in (tmp_path / "a", "oscillatory"):
        folder = tmp_path / f"sweep{len(result)}"
        sweep(source, folder, seeds=[0, 1], max_iterations=30)
        result.append([row["result"] for row in read_trial_rows(folder)])
    assert result[0] == result[1]


def test_a_trial_is_a_run(tmp_path: Path) -> None:
    sweep("oscillatory", tmp_path, seeds=[5], max_iterations=600)
    (row,) = read_trial_rows(tmp_path)
    result = run_session(OscillatorySource(), LearnerConfig(), seed=5, max_iterations=600).as_json()
    assert row["result"] == {key: result[key] for key in row["result"]}


def test_logs_are_swept_as_the_options_say(tmp_path: Path, cdmisfa: Cdmisfa) -> None:
    log = tmp_path / "log.mcap"
    write_cameras(log, {"/left": (100, 20), "/right": (100, 40)})
    short = ("--seeds", 0, "--max-iterations", 2)
    swept = ("sweep", log, "-o", tmp_path / "sweep", *short)
    learned = cdmisfa("learn", log, *LEFT, "--max-iterations", 2, "--json").json
    assert cdmisfa(*swept, *LEFT).code == 0
    (row,) = read_trial_rows(tmp_path / "sweep")
    assert row["result"] == {
        key: value
        for key, value in learned.items()
        if key not in (*DROPPED_KEYS, "notes", "warnings")
    }
    again = cdmisfa(*swept, *LEFT, "--json").json
    assert (again["skipped"], again["computed"]) == (1, 0)
    assert again["warnings"] == learned["warnings"]
    assert set(again["notes"]) <= set(learned["notes"])  # learn also states the held-out frames
    later = cdmisfa(*swept, "--topic", "/left", "--start", 0.2, "--json").json
    assert (later["skipped"], later["computed"]) == (0, 1)


# Going on


def test_only_trials_of_other_code_are_computed_again(
    cdmisfa: Cdmisfa, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[tuple[int, int, int]] = []
    quick: dict[str, Any] = {"max_iterations": 30, "progress": lambda *n: calls.append(n)}
    sweep("oscillatory", tmp_path, seeds=[0, 1], max_iterations=30)
    report = sweep("oscillatory", tmp_path, seeds=range(4), **quick)
    assert (report.trials, report.skipped, report.computed) == (4, 2, 2)
    assert calls == [(3, 0, 4), (4, 0, 4)]
    assert len((tmp_path / ROWS).read_bytes().splitlines()) == 4
    monkeypatch.setattr(store, "code", lambda *more: "0.0+other")
    words = ("sweep", "oscillatory", "--seeds", "0:5", "--max-iterations", "30", "-o", tmp_path)
    for computed in (5, 0):
        assert cdmisfa(*words, "--json").json["computed"] == computed


def test_failed_trials_are_listed_and_retried_when_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    computed: list[int] = []
    healthy = sweeping.compute_trial

    def flaky(*what: Any, seed: int, **limits: Any) -> dict[str, Any]:
        computed.append(seed)
        return {"error": "no luck"} if seed == 1 else healthy(*what, seed=seed, **limits)

    monkeypatch.setattr(sweeping, "compute_trial", flaky)
    first = sweep("oscillatory", tmp_path, seeds=range(3), max_iterations=30)
    assert [(row["seed"], row["error"]) for row in first.failed] == [(1, "no luck")]
    second = sweep("oscillatory", tmp_path, seeds=range(3), max_iterations=30)
    assert (second.skipped, len(second.failed)) == (3, 1)
    monkeypatch.setattr(sweeping, "compute_trial", healthy)
    third = sweep("oscillatory", tmp_path, seeds=range(3), max_iterations=30, retry_failed=True)
    assert (third.skipped, third.computed, third.failed) == (2, 1, ())
    assert computed == [0, 1, 2]


def test_a_row_that_was_cut_short_is_computed_again_and_a_damaged_one_named(tmp_path: Path) -> None:
    sweep("oscillatory", tmp_path, seeds=range(3), max_iterations=30)
    whole = (tmp_path / ROWS).read_bytes()
    (tmp_path / ROWS).write_bytes(whole[:-10])
    assert len(list(read_trial_rows(tmp_path))) == 2
    assert sweep("oscillatory", tmp_path, seeds=range(3), max_iterations=30).computed == 1
    assert (tmp_path / ROWS).read_bytes() == whole
    (tmp_path / ROWS).write_text('{"id": "a", "status": "done", "point": {}}\n{"id": 3}\n')
    with pytest.raises(LogDamagedError, match=r"rows\.jsonl line 2"):
        list(read_trial_rows(tmp_path))


def test_a_killed_sweep_goes_on(tmp_path: Path) -> None:
    with started("sweep", "oscillatory", "--seeds", "0:40", "-o", tmp_path) as process:
        wait_for(lambda: len(list(read_trial_rows(tmp_path))) >= 2, seconds=200)
    assert process.returncode == -signal.SIGKILL
    before = rows_of(tmp_path)
    report = sweep("oscillatory", tmp_path, seeds=range(40))
    assert report.skipped == len(before) < 40
    assert report.computed == 40 - len(before)
    assert rows_of(tmp_path).items() >= before.items()


# Workers


def busiest_worker() -> int:
    """Process id of the local worker that has done most."""
    used: dict[int, float] = {}
    for process in psutil.Process().children():
        with contextlib.suppress(psutil.Error):
            if any("popen_loky_posix" in word for word in process.cmdline()):
                used[process.pid] = sum(process.cpu_times()[:2])
    return max(used, key=lambda pid: used[pid])


def test_local_processes_give_the_same_rows_also_after_one_was_killed(
    tmp_path: Path, local: dict[str, Any]
) -> None:
    finished = 0

    def kill_a_worker(done: int, *_: int) -> None:
        nonlocal finished
        finished = done
        if done == 3:
            os.kill(busiest_worker(), signal.SIGKILL)

    how: dict[str, Any] = {"grid": GRID, "seeds": range(8), "jobs": 2}
    with pytest.raises(WorkersError, match="run again to do the rest"):
        sweep("oscillatory", tmp_path, **how, progress=kill_a_worker)
    assert 3 <= finished < 16
    report = sweep("oscillatory", tmp_path, **how)
    assert (report.skipped, report.failed) == (finished, ())
    assert rows_of(tmp_path) == local


def test_ctrl_c_of_a_terminal_ends_the_command_and_its_workers(tmp_path: Path) -> None:
    words = ("sweep", "oscillatory", "--seeds", "0:4000", "--jobs", "2", "-o", tmp_path)
    with running("-m", "cdmisfa", *words, start_new_session=True) as process:
        wait_for(lambda: len(list(read_trial_rows(tmp_path))) >= 2, seconds=200)
        children = psutil.Process(process.pid).children(recursive=True)
        os.killpg(process.pid, signal.SIGINT)
        complaint = process.communicate(timeout=10)[1]
    assert process.returncode == 130
    assert len(complaint.strip().splitlines()) == 1
    assert psutil.wait_procs(children, timeout=10)[1] == []


def test_dask_gives_the_same_rows_though_a_worker_is_killed(
    tmp_path: Path, local: dict[str, Any], cluster: tuple[str, list[subprocess.Popen[bytes]]]
) -> None:
    address, workers = cluster
    asked = threading.Event()

    def kill_a_worker(finished: int, *_: int) -> None:
        if not asked.is_set():
            asked.set()
            workers[0].send_signal(signal.SIGKILL)

    report = sweep(
        "oscillatory",
        tmp_path / "dask",
        grid=GRID,
        seeds=range(8),
        scheduler=address,
        progress=kill_a_worker,
    )
    assert workers[0].wait() == -signal.SIGKILL
    assert workers[1].poll() is None
    assert (report.computed, report.failed) == (16, ())
    assert rows_of(tmp_path / "dask") == local


# Results


@pytest.fixture
def known(tmp_path: Path) -> Path:
    """A sweep over one key: iterations 10, 20, 30 and one failed; then one trial missing."""
    rows, asked = [], []
    for k, (nu, iterations) in enumerate([(1, 10), (1, 20), (1, 30), (1, None), (2, 5), (2, 0)]):
        number, point = f"t{k}", {"learner.nu": str(nu)}
        asked.append({"id": number, "point": point})
        module = {"stream": "x1", "iteration": 4, "eta": [0.5 * k]}
        result = {"iterations": iterations, "modules": [module] * (k < 2)}
        done = {"id": number, "status": "done", "point": point, "seed": k, "result": result}
        failed = {"id": number, "status": "failed", "point": point, "seed": k, "error": "x"}
        if iterations != 0:
            rows.append(done if iterations else failed)
    (tmp_path / ROWS).write_text("".join(json.dumps(row) + "\n" for row in rows))
    (tmp_path / "sweep.json").write_text(json.dumps({"trials": asked}))
    return tmp_path


def test_means_and_deviations_are_over_finished_seeds(known: Path) -> None:
    one, two = reading.results(known)
    assert (one.trials, one.done, one.failed, one.missing) == (4, 3, 1, 0)
    assert (one.measures["iterations"].mean, one.measures["iterations"].sd) == (20.0, 10.0)
    assert one.measures["eta_1"].n == 2
    assert one.measures["eta_1"].mean == 0.25
    assert dict(one.orders) == {"x1": 2, "": 1}
    # Student with 2 degrees of freedom, and Wilson's interval of 2 of 3.
    half = 4.302653 * 10 / 3**0.5
    assert one.measures["iterations"].interval == pytest.approx((20 - half, 20 + half), abs=1e-5)
    assert one.shares["x1"] == pytest.approx((0.2077, 0.9385), abs=1e-4)
    assert two.measures["iterations"].interval is None
    assert (two.done, two.missing) == (1, 1)
    assert "eta_1" not in two.measures


def test_results_are_printed_in_every_form(cdmisfa: Cdmisfa, known: Path) -> None:
    def shown(*options: str) -> str:
        result = cdmisfa("sweep", known, "--summary", *options)
        assert result.code == 0, result.err
        return result.out

    first, second = csv.DictReader(shown("--csv").splitlines())
    assert (first["learner.nu"], float(first["iterations_sd"])) == ("1", 10.0)
    assert (second["iterations_sd"], second["eta_1_mean"]) == ("", "")
    document = json.loads(shown("--json"))
    only = {"mean": 5.0, "sd": None, "n": 1, "interval": None}
    assert document["points"][1]["measures"]["iterations"] == only
    assert (first["iterations_low"][:5], second["iterations_high"]) == ("-4.84", "")
    assert (first["order_low"][:6], first["order_high"][:6]) == ("0.2076", "0.9385")
    head, _, *rows = (re.split(r" {2,}", line) for line in shown("--quiet").splitlines())
    assert head[5:7] == ["iterations ± SD", "95 %"]
    assert rows[0][5:7] == ["20 ± 10", "-4.841 .. 44.84"]
    assert rows[1][5:7] == ["5", "-"]


# The command


def test_the_command_prints_one_document_and_names_failed_trials(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    record_scene("oscillatory", tmp_path / "log", frames=1000)
    words = [str(tmp_path / "log"), "--grid", "learner.tau=100,2000", "--seeds", "0:2"]
    words += ["--max-iterations", "20", "-o", str(tmp_path / "s"), "--json"]
    outcome = cdmisfa("sweep", *words)
    document = outcome.json
    assert outcome.code == 1
    assert (document["trials"], document["computed"], len(document["failed"])) == (4, 2, 2)
    assert {row["point"]["learner.tau"] for row in document["failed"]} == {"2000"}
    assert all("frames" in row["error"] for row in document["failed"])
    summary = cdmisfa("sweep", tmp_path / "s", "--summary", "--json").json["points"][0]
    assert "leaves out" not in outcome.err
    words = [str(tmp_path / "log"), "--algorithm", "progress", "--seeds", "0:1"]
    outcome = cdmisfa("sweep", *words, "--max-iterations", "3", "-o", str(tmp_path / "s"))
    assert "--summary leaves out 4 trials" in outcome.err
    # The log has 10 blocks of 100 frames.
    assert (summary["done"], summary["measures"]["iterations"]["mean"]) == (2, 10.0)


def test_grids_and_seeds_are_read_as_written() -> None:
    assert parse_grid(("learner.sigma=0, .1", "learner.tau=40")) == {
        "learner.sigma": ["0", ".1"],
        "learner.tau": ["40"],
    }
    assert parse_seeds("0:3,7") == [0, 1, 2, 7]
    for text in ("", "3:3", "-1", "a", "0:99999999999"):
        with pytest.raises(click.UsageError, match="--seeds"):
            parse_seeds(text)
    for words in (("learner.sigma",), ("=1",), ("a.b=",)):
        with pytest.raises(click.UsageError, match="--grid"):
            parse_grid(words)
