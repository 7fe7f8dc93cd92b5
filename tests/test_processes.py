"""Worker processes: they end with who asked, bring nothing of it with them, and may die."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import psutil
import pytest
from engine_tasks import die_while_sending, sleep_for, trace
from waiting import wait_for

from cdmisfa.core.errors import UsageError
from cdmisfa.core.processes import WORKER_ENVIRONMENT, WorkersError, run_all, workers

SCRIPT = """
import sys
from engine_tasks import sleep_for, trace
from cdmisfa.core.processes import workers
print("begun")
with workers(2) as submit:
    print(submit(trace, (sys.argv[1], 3, "")).result(), flush=True)
    futures = [submit(bytes, 1 << 20), *(submit(sleep_for, 600) for _ in range(2))]
    futures[1].result()
"""
"""A user's script, which does not ask whether it is the main module."""


def begun(folder: Path) -> tuple[subprocess.Popen[str], list[psutil.Process]]:
    """The script, with its two workers asleep, and all processes that it has."""
    (folder / "script.py").write_text(SCRIPT)
    here = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    process = subprocess.Popen(
        [sys.executable, "script.py", str(folder)],
        cwd=folder,
        env={**here, "TMPDIR": str(folder)},
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    wait_for(lambda: (folder / "3").exists(), seconds=60)
    time.sleep(1)
    children = psutil.Process(process.pid).children(recursive=True)
    assert len(children) >= 2
    return process, children


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_they_end_with_their_parent_and_leave_nothing(tmp_path: Path, how: signal.Signals) -> None:
    process, children = begun(tmp_path)
    if how == signal.SIGINT:  # of a terminal: to all of them
        os.killpg(process.pid, how)
    else:
        process.kill()
    left = psutil.wait_procs(children, timeout=20)[1]
    for child in left:  # which would keep the pipe open
        child.kill()
    out, err = process.communicate(timeout=60)
    assert left == []
    assert out.split() == ["begun", "9"]
    assert not list(tmp_path.glob("cdmisfa-workers-*"))
    if how == signal.SIGINT:
        assert err.count("Traceback") == 1
        assert err.rstrip().endswith("KeyboardInterrupt")


def test_leaving_does_not_wait_for_what_they_are_doing() -> None:
    with workers(2) as submit:
        futures = [submit(sleep_for, 600), *(submit(bytes, 1 << 26) for _ in range(8))]
        assert len(futures[1].result()) == 1 << 26
        start = time.monotonic()
    assert time.monotonic() - start < 5
    assert all(future.done() for future in futures)


def killed_while_sending(size: int, seconds: float) -> None:
    """Have one of two workers die so many seconds after it began to send a result."""
    with workers(2) as submit:
        sleeping = submit(sleep_for, 600)
        submit(os.getpid).result()
        submit(die_while_sending, size, seconds).result(timeout=60)
        sleeping.result(timeout=10)  # the other result may have come before the end


@pytest.mark.parametrize(
    ("size", "seconds"), [(100, 0.0), (3000, 1e-4), (60_000, 1e-3), (1 << 29, 0.1), (1 << 29, 0.3)]
)
def test_one_that_is_killed_while_it_sends_ends_the_work(size: int, seconds: float) -> None:
    with pytest.raises(WorkersError, match="a worker was killed"):
        killed_while_sending(size, seconds)


def test_they_have_their_environment_before_anything_is_imported(tmp_path: Path) -> None:
    with workers(1) as submit:
        assert submit(os.getenv, "OPENBLAS_NUM_THREADS").result() == "1"
        assert submit(signal.pthread_sigmask, signal.SIG_BLOCK, ()).result() >= {signal.SIGINT}
    assert WORKER_ENVIRONMENT["OPENBLAS_NUM_THREADS"] == "1"
    assert trace((str(tmp_path), 2, "")) == 4


@pytest.mark.parametrize("jobs", [1, 3])
def test_every_task_is_computed_once(tmp_path: Path, jobs: int) -> None:
    tasks = [(str(tmp_path), number, "") for number in range(20)]
    assert sorted(run_all(trace, tasks, jobs=jobs)) == [(n, n * n) for n in range(20)]
    assert {file.stat().st_size for file in tmp_path.iterdir()} == {1}
    assert list(run_all(trace, [], jobs=jobs)) == []


@pytest.mark.parametrize(
    ("greeting", "message"),
    [(None, "no answer within"), (b"HTTP/1.1 400 Bad Request", "another program answers")],
)
def test_a_server_that_is_no_scheduler_is_refused(
    greeting: bytes | None, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed")
    if greeting is None:
        monkeypatch.setattr("cdmisfa.core.processes.CONNECT_SECONDS", 1)
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            with server.accept()[0] as connection:
                connection.sendall(greeting or b"")

        if greeting:
            threading.Thread(target=answer, daemon=True).start()
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(UsageError, match=f"no dask cluster at {address}: {message}"):
            list(run_all(abs, [1, 2], scheduler=address))
    with pytest.raises(UsageError, match="no dask cluster at foo://1: unknown address scheme"):
        list(run_all(abs, [1, 2], scheduler="foo://1"))
