"""Computation in this process, in others of this machine, or on a dask cluster."""

from __future__ import annotations

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

from cdmisfa.core.errors import CdmisfaError, UsageError, one_line

Task = TypeVar("Task")
Result = TypeVar("Result")

# Has a worker call a function with arguments.
Submit = Callable[..., Future[Any]]

# How long a scheduler and its first worker may take to answer.
CONNECT_SECONDS = 15

# Tasks that a cluster has at a time: more than it has workers, few enough to hand out soon.
IN_CLUSTER = 1000

# Environment of local workers: the processes are the parallelism.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")


def thread_count() -> int:
    """Return the number of threads that this process may use: OMP_NUM_THREADS, or processors."""
    setting = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0]
    return int(setting) if setting.isdecimal() and 0 < int(setting) < 1000 else os.cpu_count() or 1


class WorkersError(CdmisfaError):
    """Workers died or cannot be reached; what is finished is kept."""


def run_all(
    function: Callable[[Task], Result],
    tasks: Sequence[Task],
    *,
    jobs: int = 1,
    scheduler: str | None = None,
) -> Iterator[tuple[int, Result]]:
    """Compute function(task) for every task, in any order.

    Args:
        function: importable by name from every worker; an exception of its own ends the loop.
        tasks: picklable.
        jobs: local processes; with 1 everything is computed in this one.
        scheduler: address of a dask scheduler, whose workers compute instead.

    Yields:
        The task's index and its result, as they come.

    Raises:
        UsageError: dask is not installed.
        WorkersError: a worker died, or the scheduler does not answer.
    """
    jobs = min(jobs, len(tasks))
    if jobs == 0 or (jobs == 1 and scheduler is None):
        for index, task in enumerate(tasks):
            yield index, function(task)
        return
    waiting, running = iter(enumerate(tasks)), dict[Future[Result], int]()
    most = jobs if scheduler is None else IN_CLUSTER
    with workers(jobs) if scheduler is None else _dask_workers(scheduler) as submit:
        while True:
            for index, task in itertools.islice(waiting, most - len(running)):
                running[submit(function, task)] = index
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                yield running.pop(future), future.result()


@contextlib.contextmanager
def workers(jobs: int) -> Iterator[Submit]:
    """Start local processes; they end with the context, or with this process if it is killed.

    Args:
        jobs: how many.

    Raises:
        WorkersError: a worker died; nothing that was submitted is computed any more.
    """
    from joblib.externals.loky import ProcessPoolExecutor

    _start_trackers()
    # It warns of workers that it replaces as they have grown, and where pgrep is missing.
    warnings.filterwarnings("ignore", module=r"joblib\.externals\.loky")
    with tempfile.TemporaryDirectory(prefix="cdmisfa-workers-") as folder:
        begin = (os.getpid(), folder)
        pool = ProcessPoolExecutor(jobs, env=ONE_THREAD, initializer=_end_with, initargs=begin)

        def submit(function: Callable[..., Any], *arguments: Any) -> Future[Any]:
            # Processes start in here: a Ctrl-C of the terminal is for this process only.
            before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
            try:
                future: Future[Any] = pool.submit(_call, folder, function, arguments)
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
            return future

        try:
            yield submit
        except BrokenProcessPool as error:
            why = "a worker process was killed: repeat the command, what is finished is kept"
            raise WorkersError(why) from error
        finally:
            pool.shutdown(kill_workers=True)


def _start_trackers() -> None:
    """Start the processes that remove what killed ones left, so that they print nothing.

    The start of Python's unblocks signals, also where a worker that starts it shall have none.
    """
    import multiprocessing.resource_tracker as of_python

    import joblib.externals.loky.backend.resource_tracker as of_loky

    before = os.environ.get("PYTHONWARNINGS")
    os.environ["PYTHONWARNINGS"] = "ignore"
    try:
        of_python.ensure_running()
        of_loky.ensure_running()
    finally:
        del os.environ["PYTHONWARNINGS"]
        if before is not None:
            os.environ["PYTHONWARNINGS"] = before


def _end_with(parent: int, folder: str) -> None:
    """End this worker when its parent is gone, also when that was killed."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        shutil.rmtree(folder, ignore_errors=True)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _call(folder: str, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    """Call a function in a worker; what is large comes back through a file.

    All workers send through one pipe. One that is killed in the midst of a message leaves a part
    of it, for whose rest loky waits for ever. A write of up to `PIPE_BUF` bytes is never a part.
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
    """A result in a file: what is unpickled of it is the result."""

    def __init__(self, path: str) -> None:
        self._path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return _read, (self._path,)


def _read(path: str) -> Any:
    with open(path, "rb") as file:
        os.unlink(path)
        return pickle.load(file)


@contextlib.contextmanager
def _dask_workers(scheduler: str) -> Iterator[Submit]:
    """Connect to a dask cluster, whose other workers try a task again when one died of it.

    joblib's own backend for dask (1.6) waits for ever for a task that every worker died of.
    """
    try:
        distributed: Any = importlib.import_module("distributed")
    except ImportError as error:
        why = "--scheduler needs a package that is missing: pip install 'cdmisfa[dask]'"
        raise UsageError(why) from error
    # Else it logs a traceback of every lost connection; the errors that matter are raised.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    with contextlib.ExitStack() as stack:
        try:
            distributed.comm.resolve_address(scheduler)  # else a traceback after half a minute
            client = distributed.Client(scheduler, timeout=CONNECT_SECONDS, set_as_default=False)
            stack.enter_context(contextlib.closing(client))
            client.wait_for_workers(1, timeout=CONNECT_SECONDS)
        except (OSError, TimeoutError, ValueError) as error:
            why = f"no dask scheduler with workers answers at {scheduler}: {one_line(error)}"
            raise WorkersError(why) from error
        try:
            yield client.get_executor(pure=False).submit
        except (distributed.KilledWorker, CancelledError) as error:
            why = f"the dask cluster was lost, what is finished is kept: {one_line(error)}"
            raise WorkersError(why) from error
