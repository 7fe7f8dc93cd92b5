"""Where work is computed: in this process, in others of this machine, or on dask."""

from __future__ import annotations

import contextlib
import importlib
import logging
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    CancelledError,
    Future,
    ThreadPoolExecutor,
    wait,
)
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

from cdmisfa.core.errors import CdmisfaError, UsageError, one_line
from cdmisfa.core.registry import did_you_mean

Task = TypeVar("Task")
Result = TypeVar("Result")

ENGINES = ("local", "dask")

ATTEMPTS = 3
"""A task whose local worker died is computed so often, the last time with nothing beside it."""

WENT_AWAY = "the scheduler went away: start it and say the same again, finished trials are kept"

CONNECT_SECONDS = 15
"""How long a scheduler and its first worker may take to answer."""

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
"""Environment of local workers: the processes are the parallelism."""

_starting = threading.Lock()


def thread_count() -> int:
    """Threads that this process may use at once: as many as processors, or OMP_NUM_THREADS says."""
    said = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0]
    return int(said) if said.isdecimal() and 0 < int(said) < 1000 else os.cpu_count() or 1


class EngineError(CdmisfaError):
    """An engine is out of reach or went away; finished trials are kept."""


class Workers:
    """A pool of threads, each with a process of its own that computes what it is given.

    A call whose process died ends with `BrokenProcessPool`, and the next call has a new process.
    All end at `close`, and when this process is killed, whatever they are doing. A terminal's
    Ctrl-C is for this process only.

    `ProcessPoolExecutor` shares one pipe among its processes: when one is killed while it sends a
    result, it waits forever for the rest. So here each process has a pipe of its own.

    Args:
        jobs: how many.
        environment: variables of the processes, set before they import anything.
    """

    def __init__(self, jobs: int, environment: Mapping[str, str] | None = None) -> None:
        self._environment = dict(environment or {})
        self._threads = ThreadPoolExecutor(jobs)
        self._own = threading.local()
        self._processes: list[BaseProcess] = []
        self._closed = False

    def submit(self, function: Callable[..., Result], *arguments: Any) -> Future[Result]:
        """Have one of them call a function, which is importable by name."""
        return self._threads.submit(self._call, function, arguments)

    def close(self) -> None:
        """End them all at once, whatever they are doing; harmless when called twice."""
        with _starting:
            self._closed = True
            for process in self._processes:
                process.kill()
        self._threads.shutdown()
        for process in self._processes:
            process.join()

    def _call(self, function: Callable[..., Result], arguments: tuple[Any, ...]) -> Result:
        pipe: Connection | None = getattr(self._own, "pipe", None)
        if pipe is None:
            pipe = self._own.pipe = self._begin()
        try:
            pipe.send((function, arguments))
            failed, value = pipe.recv()
        except (EOFError, OSError) as error:
            pipe.close()
            self._own.pipe = None
            raise BrokenProcessPool("a worker process ended") from error
        if failed:
            raise value
        result: Result = value
        return result

    def _begin(self) -> Connection:
        """Start a process; its end of the pipe is here no more, so that its death shows."""
        context = multiprocessing.get_context("spawn")
        resource_tracker.ensure_running()  # before Ctrl-C is blocked: its start unblocks it
        with _starting, _without_main_and_signals():
            if self._closed:
                raise BrokenProcessPool("the worker processes were closed")
            ours, theirs = context.Pipe()
            process = context.Process(target=_serve, args=(theirs, self._environment), daemon=True)
            process.start()
            self._processes.append(process)
        theirs.close()
        return ours


@contextlib.contextmanager
def _without_main_and_signals() -> Iterator[None]:
    """Let a process that is started inherit no signal of a terminal and no main module.

    The main module is a command or a user's script, which would begin anew in each of them.
    """
    main = sys.modules["__main__"].__dict__
    hidden: dict[str, Any] = {n: main[n] for n in ("__file__", "__spec__") if n in main}
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
    try:
        main.pop("__file__", None)
        main["__spec__"] = None
        yield
    finally:
        main.update(hidden)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(pipe: Connection, environment: Mapping[str, str]) -> None:
    """Answer calls from a pipe until its other end is gone; the main function of a worker."""
    os.environ.update(environment)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with contextlib.suppress(EOFError, OSError):
        while True:
            pipe.send_bytes(_answer(pipe.recv_bytes()))


def _end_with_parent() -> None:
    if (parent := multiprocessing.parent_process()) is not None:
        parent.join()
    os._exit(1)


def _answer(message: bytes) -> bytes:
    """The pickled pair (failed, result or exception) of a pickled call."""
    try:
        function, given = pickle.loads(message)
        return pickle.dumps((False, function(*given)))
    except BaseException as error:
        error.add_note("".join(traceback.format_exception(error)))
        try:
            answer = pickle.dumps((True, error))
            pickle.loads(answer)
        except Exception:
            return pickle.dumps((True, RuntimeError(f"{type(error).__name__}: {error}")))
        return answer


@dataclass(frozen=True, slots=True)
class WorkerDied:
    """Instead of a result: every worker that tried this task died."""

    what: str


@dataclass(frozen=True, slots=True)
class _Pool:
    """Workers, as `run_all` uses them.

    Attributes:
        submit: has a worker call a function with a task.
        width: how many tasks to hand out at a time.
        died: what a future raises when its worker died.
        attempts: how often a task is handed out whose worker died.
        close: lets the workers go.
    """

    submit: Callable[..., Future[Any]]
    width: Callable[[], int]
    died: type[BaseException]
    attempts: int
    close: Callable[[], None]


def run_all(
    function: Callable[[Task], Result],
    tasks: Sequence[Task],
    *,
    jobs: int = 1,
    engine: str = "local",
    scheduler: str | None = None,
) -> Iterator[tuple[int, Result | WorkerDied]]:
    """Compute function(task) for every task, in any order.

    Args:
        function: importable by name from every worker; an exception of its own ends the loop.
        tasks: picklable.
        jobs: local processes; with 1 everything is computed in this one.
        engine: one of `ENGINES`.
        scheduler: address of a dask scheduler; without it one is started here.

    Yields:
        The task's index and its result, as they come.

    Raises:
        UsageError: no such engine, or its package is not installed.
        EngineError: nobody answers at the scheduler's address, or it went away.
    """
    if engine not in ENGINES:
        raise UsageError(f"no engine {engine!r}: {did_you_mean(engine, ENGINES)}")
    if scheduler is not None and engine == "local":
        raise UsageError(f"--scheduler {scheduler} needs --engine dask")
    if not tasks:
        return
    if engine == "local" and jobs == 1:
        for index, task in enumerate(tasks):
            yield index, function(task)
        return
    pool = _dask_pool(jobs, scheduler) if engine == "dask" else _local_pool(jobs)
    with contextlib.closing(pool):
        left: Iterable[int] = range(len(tasks))
        for attempt in range(1, pool.attempts + 1):
            died: list[int] = []
            last = attempt == pool.attempts
            alone = last and attempt > 1
            for index, result in _spread(pool, function, tasks, left, alone=alone):
                if isinstance(result, WorkerDied) and not last:
                    died.append(index)
                else:
                    yield index, result
            left = died


def _spread(
    pool: _Pool,
    function: Callable[[Task], Result],
    tasks: Sequence[Task],
    indices: Iterable[int],
    *,
    alone: bool,
) -> Iterator[tuple[int, Result | WorkerDied]]:
    """Hand out some tasks, once each, as many at a time as keep the workers busy."""
    waiting, running = deque(indices), dict[Future[Result], int]()
    while waiting or running:
        width = 1 if alone else pool.width() if waiting else 0
        while waiting and len(running) < width:
            index = waiting.popleft()
            running[pool.submit(function, tasks[index])] = index
        done, _ = wait(running, return_when=FIRST_COMPLETED)
        for future in done:
            result: Result | WorkerDied
            try:
                result = future.result()
            except pool.died as error:
                result = WorkerDied(f"every worker that tried it died ({one_line(error)})")
            except CancelledError as error:
                raise EngineError(WENT_AWAY) from error
            yield running.pop(future), result


def _local_pool(jobs: int) -> _Pool:
    """Processes of this machine."""
    workers = Workers(jobs, ONE_THREAD)
    return _Pool(workers.submit, lambda: jobs + 1, BrokenProcessPool, ATTEMPTS, workers.close)


def _dask_pool(jobs: int, scheduler: str | None) -> _Pool:
    """A dask cluster, or one started here for the while; it tries other workers by itself."""
    try:
        distributed: Any = importlib.import_module("distributed")
    except ImportError as error:
        raise UsageError(
            "--engine dask needs a package that is not installed: pip install 'cdmisfa[dask]'"
        ) from error
    # Else it logs a traceback of every lost connection; what matters is raised.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    how: dict[str, Any] = {"address": scheduler, "timeout": CONNECT_SECONDS}
    if scheduler is None:
        how = {"n_workers": jobs, "threads_per_worker": 1, "dashboard_address": None}
    try:
        if scheduler is not None:  # a wrong one would be a traceback after half a minute
            distributed.comm.resolve_address(scheduler)
        client = distributed.Client(**how, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise EngineError(f"no dask scheduler answers at {scheduler}: {one_line(error)}") from error
    try:
        client.wait_for_workers(1, timeout=CONNECT_SECONDS)
    except TimeoutError as error:
        client.close()
        raise EngineError(
            f"the dask scheduler at {scheduler} has no workers: start some with "
            f"dask worker {scheduler}"
        ) from error

    def width() -> int:
        """Two for each thread of the workers that are there now."""
        try:
            threads: int = sum(client.ncores().values())
        except OSError as error:
            raise EngineError(WENT_AWAY) from error
        return max(2 * threads, 1)

    submit = client.get_executor(pure=False).submit
    return _Pool(submit, width, distributed.KilledWorker, 1, client.close)
