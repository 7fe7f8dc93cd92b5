"""Worker processes: they end with who asked, and bring nothing of it with them."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import psutil
import pytest
from engine_tasks import die_while_sending, sleep_for, trace
from waiting import wait_for

from cdmisfa.core.processes import Workers

SCRIPT = """
import contextlib, sys
from engine_tasks import sleep_for, trace
from cdmisfa.core.processes import Workers
print("begun")
with contextlib.closing(Workers(2)) as workers:
    print(workers.submit(trace, (sys.argv[1], 3, "")).result(), flush=True)
    futures = [workers.submit(sleep_for, 600) for _ in range(2)]
    futures[0].result()
"""
"""A user's script, which does not ask whether it is the main module."""


def begun(folder: Path) -> tuple[subprocess.Popen[str], list[psutil.Process]]:
    """The script, with its two workers asleep."""
    (folder / "script.py").write_text(SCRIPT)
    here = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    process = subprocess.Popen(
        [sys.executable, "script.py", str(folder)],
        cwd=folder,
        env=here,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )

    def workers() -> list[psutil.Process]:
        found = psutil.Process(process.pid).children()
        return [child for child in found if "spawn_main" in " ".join(child.cmdline())]

    wait_for(lambda: (folder / "3").exists() and len(workers()) == 2, seconds=60)
    return process, workers()


def test_they_end_when_their_parent_is_killed(tmp_path: Path) -> None:
    process, workers = begun(tmp_path)
    process.kill()
    left = psutil.wait_procs(workers, timeout=20)[1]
    for worker in left:  # which would keep the pipe open
        worker.kill()
    out, _ = process.communicate()
    assert out.split() == ["begun", "9"]
    assert left == []


def test_ctrl_c_of_a_terminal_is_for_their_parent_only(tmp_path: Path) -> None:
    process, workers = begun(tmp_path)
    time.sleep(0.5)  # Python overlooks a signal that comes just as it begins to wait for a lock
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode != 0
    assert err.count("Traceback") == 1
    assert err.rstrip().endswith("KeyboardInterrupt")
    assert psutil.wait_procs(workers, timeout=20)[1] == []


def test_closing_does_not_wait_for_what_they_are_doing() -> None:
    workers = Workers(1)
    future = workers.submit(sleep_for, 600)
    wait_for(future.running, seconds=60)
    start = time.monotonic()
    workers.close()
    workers.close()
    assert time.monotonic() - start < 10
    with pytest.raises(BrokenProcessPool):
        future.result()


def test_what_sends_large_results_is_not_waited_for() -> None:
    workers = Workers(2)
    futures = [workers.submit(bytes, 1 << 26) for _ in range(8)]
    futures[0].result()  # others are in the midst of being sent
    closing = threading.Thread(target=workers.close, daemon=True)
    closing.start()
    closing.join(20)
    assert not closing.is_alive()
    assert all(future.done() for future in futures)


def test_one_that_is_killed_while_it_sends_costs_its_own_result_only() -> None:
    """The other lives, and must not keep its half message open."""
    with contextlib.closing(Workers(2)) as workers:
        workers.submit(os.getpid).result()
        sleeping = workers.submit(sleep_for, 600)
        with pytest.raises(BrokenProcessPool):
            workers.submit(die_while_sending, 1 << 30).result(timeout=20)
        assert workers.submit(abs, -3).result(timeout=20) == 3
        assert sleeping.running()


def test_errors_come_back_and_what_cannot_be_sent_is_one() -> None:
    with contextlib.closing(Workers(1)) as workers:
        for asked, error in (
            (workers.submit(int, "x"), ValueError),
            (workers.submit(threading.Lock), TypeError),
            (workers.submit(len, threading.Lock()), TypeError),
        ):
            with pytest.raises(error):
                asked.result(timeout=60)
        assert workers.submit(abs, -3).result(timeout=60) == 3


def test_they_have_their_environment_before_anything_is_imported(tmp_path: Path) -> None:
    workers = Workers(1, environment={"OPENBLAS_NUM_THREADS": "1"})
    assert workers.submit(os.getenv, "OPENBLAS_NUM_THREADS").result() == "1"
    workers.close()
    assert trace((str(tmp_path), 2, "")) == 4
