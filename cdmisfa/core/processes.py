"""Compute many tasks: in this process, in local worker processes, or on a dask cluster."""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import itertools
import logging
import os
import pickle
import select
import shutil
import signal
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

from cdmisfa.core.errors import CdmisfaError, UsageError, needs, one_line

Task = TypeVar("Task")
Result = TypeVar("Result")

# Calls a function with arguments in a worker.
Submit = Callable[..., Future[Any]]

# Seconds that a dask scheduler may take to answer, and then its first worker.
CONNECT_SECONDS, WORKER_SECONDS = 6, 15

# Tasks that a cluster has at a time: more than its workers, and few enough to submit quickly.
MAX_SUBMITTED = 1000

# Environment of local workers: one thread each, since there are as many workers as processors.
WORKER_ENVIRONMENT = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")


def thread_count() -> int:
    """Return the number of threads to use: OMP_NUM_THREADS, or the number of processors."""
    setting = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0]
    return int(setting) if setting.isdecimal() and 0 < int(setting) < 1000 else os.cpu_count() or 1


class WorkersError(CdmisfaError):
    """Workers that died or cannot be reached; results of finished tasks are kept."""


def run_all(
    function: Callable[[Task], Result],
    tasks: Sequence[Task],
    *,
    jobs: int = 1,
    scheduler: str | None = None,
) -> Iterator[tuple[int, Result]]:
    """Compute function(task) for every task, in any order.

    Args:
        function: a function that every worker can import; an exception of it ends the iteration.
        tasks: picklable tasks.
        jobs: number of local processes; 1: compute in this process.
        scheduler: address of a dask scheduler whose workers compute instead.

    Yields:
        Index and result of a task, as soon as it is finished.

    Raises:
        MissingPackageError: dask is not installed.
        UsageError: no scheduler answers.
        WorkersError: a worker died.
    """
    jobs = min(jobs, len(tasks))
    if jobs == 0 or (jobs == 1 and scheduler is None):
        for index, task in enumerate(tasks):
            yield index, function(task)
        return
    waiting, running = iter(enumerate(tasks)), dict[Future[Result], int]()
    limit = jobs if scheduler is None else MAX_SUBMITTED
    with workers(jobs) if scheduler is None else _dask_workers(scheduler) as submit:
        while True:
            for index, task in itertools.islice(waiting, limit - len(running)):
                running[submit(function, task)] = index
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                yield running.pop(future), future.result()


@contextlib.contextmanager
def workers(jobs: int) -> Iterator[Submit]:
    """Start local processes; they end with the context, or with this process if it is killed.

    Args:
        jobs: number of processes.

    Raises:
        WorkersError: a worker died; no further task is computed.
    """
    from joblib.externals.loky import ProcessPoolExecutor

    _start_trackers()
    # loky warns when it replaces a worker whose memory has grown, and if pgrep is missing.
    warnings.filterwarnings("ignore", module=r"joblib\.externals\.loky")
    with tempfile.TemporaryDirectory(prefix="cdmisfa-workers-") as folder:
        begin = (os.getpid(), folder)
        pool = ProcessPoolExecutor(
            jobs, env=WORKER_ENVIRONMENT, initializer=_end_with, initargs=begin
        )

        def submit(function: Callable[..., Any], *arguments: Any) -> Future[Any]:
            # loky starts its processes here: they must not receive a Ctrl-C of the terminal.
            before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
            try:
                future: Future[Any] = pool.submit(_call, folder, function, arguments)
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
            return future

        try:
            yield submit
        except BrokenProcessPool as error:
            raise WorkersError("a worker was killed: run again to do the rest") from error
        finally:
            pool.shutdown(kill_workers=True)


def _start_trackers() -> None:
    """Start the processes that remove resources of killed processes, without their warnings.

    They start here, because starting Python's own unblocks signals, also in a worker that must not
    receive any.
    """
    import multiprocessing.resource_tracker as python_tracker

    import joblib.externals.loky.backend.resource_tracker as loky_tracker

    before = os.environ.get("PYTHONWARNINGS")
    os.environ["PYTHONWARNINGS"] = "ignore"
    try:
        python_tracker.ensure_running()
        loky_tracker.ensure_running()
    finally:
        del os.environ["PYTHONWARNINGS"]
        if before is not None:
            os.environ["PYTHONWARNINGS"] = before


def _end_with(parent: int, folder: str) -> None:
    """End this worker when its parent has ended or was killed."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        shutil.rmtree(folder, ignore_errors=True)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _call(folder: str, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    """Call a function in a worker, and return a large result through a file.

    All workers of loky send through one pipe. A worker that is killed within a message leaves a
    part of it, and loky waits for the rest forever. Writes of up to `PIPE_BUF` bytes are atomic.
    """
    result = function(*arguments)
    data = pickle.dumps(result)
    if len(data) < select.PIPE_BUF // 2:
        return result
    handle, path = tempfile.mkstemp(dir=folder)
    with open(handle, "wb") as file:
        file.write(data)
    return _Filed(path)


class _Filed:
    """Result that is stored in a file; unpickling this object returns the result."""

    def __init__(self, path: str) -> None:
        self._path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return _read, (self._path,)


def _read(path: str) -> Any:
    """Return the result in a file, and remove the file."""
    with open(path, "rb") as file:
        os.unlink(path)
        return pickle.load(file)


@contextlib.contextmanager
def _dask_workers(scheduler: str) -> Iterator[Submit]:
    """Connect to a dask cluster, which repeats a task on other workers if its worker died.

    joblib's own backend for dask (1.6) waits forever for a task that has killed every worker.
    """
    with needs("--scheduler", "distributed", "'cdmisfa[dask]'"):
        distributed: Any = importlib.import_module("distributed")
    # Otherwise it logs a traceback for every lost connection; errors that matter are raised.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)

    async def greet() -> None:
        """Connect once; a client (2026.8) waits forever for a server that sends no greeting."""
        secured = distributed.Security().get_connection_args("client")
        comm = await asyncio.wait_for(distributed.core.connect(scheduler, **secured), limit)
        await comm.close()

    limit = CONNECT_SECONDS
    with contextlib.ExitStack() as stack:
        try:
            distributed.utils.LoopRunner().run_sync(greet)
            client = distributed.Client(scheduler, timeout=limit, set_as_default=False)
            stack.enter_context(contextlib.closing(client))
            client.wait_for_workers(1, timeout=WORKER_SECONDS)
        except (OSError, ValueError, MemoryError) as error:
            reason = one_line(error) if str(error) else f"no answer within {limit} s"
            if isinstance(error, MemoryError):  # it takes other bytes for the length of a greeting
                reason = "another program answers there"
            raise UsageError(f"--scheduler: no dask cluster at {scheduler}: {reason}") from error
        try:
            yield client.get_executor(pure=False).submit
        except (distributed.KilledWorker, CancelledError) as error:
            raise WorkersError(
                f"the dask cluster was lost; finished results are kept: {one_line(error)}"
            ) from error
