"""Where trials are computed: here, in local processes or on dask, by one loop.

Every engine is something that turns a task into a future. The loop keeps the workers
busy, hands back each result as it comes, and gives the task of a worker that died
(killed, out of memory) to another one.
"""

from __future__ import annotations

import contextlib
import importlib
import logging
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from cdmisfa.core.errors import CdmisfaError, UsageError, one_line
from cdmisfa.core.processes import Workers
from cdmisfa.core.registry import did_you_mean

Task = TypeVar("Task")
Result = TypeVar("Result")

Died = tuple[type[BaseException], ...]

ENGINES = ("local", "dask")

DEATHS = 3
"""A task whose worker died so often, the last time with nothing beside it, is given up."""

WENT_AWAY = "the scheduler went away: start it and say the same again, finished trials are kept"

CONNECT_SECONDS = 15
"""How long a scheduler and its first worker may take to answer."""

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
"""Environment of local workers: the processes are the parallelism."""


class EngineError(CdmisfaError):
    """An engine is out of reach or went away; finished trials are kept."""


@dataclass(frozen=True, slots=True)
class WorkerDied:
    """Instead of a result: every worker that tried this task died."""

    what: str


class Pool(Protocol):
    """What an engine gives the loop."""

    died: Died
    """What a future raises when its worker died."""

    gave_up: bool
    """Whether the engine has tried other workers by then."""

    @property
    def width(self) -> int:
        """How many tasks to hand out at a time."""

    def submit(self, function: Callable[[Task], Result], task: Task) -> Future[Result]:
        """Have a worker compute function(task)."""

    def renew(self) -> None:
        """Replace what broke when a worker died."""

    def close(self) -> None:
        """Let the workers go."""


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
    with contextlib.closing(_open(engine, jobs, scheduler)) as pool:
        yield from _spread(pool, function, tasks)


def _spread(
    pool: Pool, function: Callable[[Task], Result], tasks: Sequence[Task]
) -> Iterator[tuple[int, Result | WorkerDied]]:
    deaths: Counter[int] = Counter()
    waiting, alone = deque(range(len(tasks))), deque[int]()
    running: dict[Future[Result], int] = {}
    while True:
        width = pool.width if waiting else 0
        while waiting and len(running) < width:
            index = waiting.popleft()
            running[pool.submit(function, tasks[index])] = index
        if not running:
            if not alone:
                return
            index = alone.popleft()
            running[pool.submit(function, tasks[index])] = index
        done, _ = wait(running, return_when=FIRST_COMPLETED)
        if not pool.gave_up and any(isinstance(f.exception(), pool.died) for f in done):
            # One death breaks the whole pool: what else was running is lost with it.
            done, _ = wait(running)
            pool.renew()
        lost: dict[int, BaseException] = {}
        for future in done:
            index = running.pop(future)
            try:
                result = future.result()
            except pool.died as error:
                lost[index] = error
            except CancelledError as error:
                raise EngineError(WENT_AWAY) from error
            else:
                yield index, result
        for index, death in lost.items():
            deaths[index] += 1
            if pool.gave_up or deaths[index] >= DEATHS:
                yield index, WorkerDied(f"every worker that tried it died ({one_line(death)})")
            elif deaths[index] == DEATHS - 1:
                alone.append(index)
            else:
                waiting.appendleft(index)


def _open(engine: str, jobs: int, scheduler: str | None) -> Pool:
    return DaskPool(jobs, scheduler) if engine == "dask" else LocalPool(jobs)


class LocalPool:
    """Processes of this machine."""

    died: Died = (BrokenProcessPool,)
    gave_up = False

    def __init__(self, jobs: int) -> None:
        self.width = jobs + 1
        self._jobs = jobs
        self._workers = Workers(jobs, environment=ONE_THREAD)

    def submit(self, function: Callable[[Task], Result], task: Task) -> Future[Result]:
        """See `Pool`."""
        return self._workers.submit(function, task)

    def renew(self) -> None:
        """See `Pool`."""
        self.close()
        self._workers = Workers(self._jobs, environment=ONE_THREAD)

    def close(self) -> None:
        """See `Pool`."""
        self._workers.close()


class DaskPool:
    """A dask cluster, or one started here for the while."""

    gave_up = True

    def __init__(self, jobs: int, scheduler: str | None) -> None:
        try:
            distributed: Any = importlib.import_module("distributed")
        except ImportError as error:
            raise UsageError(
                "--engine dask needs a package that is not installed: pip install 'cdmisfa[dask]'"
            ) from error
        # It tells of every lost connection with a traceback; what matters is raised.
        logging.getLogger("distributed").setLevel(logging.CRITICAL)
        self.died: Died = (distributed.KilledWorker,)
        try:
            if scheduler is None:
                self._client = distributed.Client(
                    n_workers=jobs,
                    threads_per_worker=1,
                    dashboard_address=None,
                    set_as_default=False,
                )
            else:
                self._client = distributed.Client(
                    scheduler, timeout=CONNECT_SECONDS, set_as_default=False
                )
        except (OSError, TimeoutError, ValueError) as error:
            raise EngineError(
                f"no dask scheduler answers at {scheduler}: {one_line(error)}"
            ) from error
        try:
            self._client.wait_for_workers(1, timeout=CONNECT_SECONDS)
        except TimeoutError as error:
            self._client.close()
            raise EngineError(
                f"the dask scheduler at {scheduler} has no workers: start some with "
                f"dask worker {scheduler}"
            ) from error
        self._executor = self._client.get_executor(pure=False)

    @property
    def width(self) -> int:
        """Two for each thread of the workers that are there now.

        Raises:
            EngineError: the scheduler went away.
        """
        try:
            threads: int = sum(self._client.ncores().values())
        except OSError as error:
            raise EngineError(WENT_AWAY) from error
        return max(2 * threads, 1)

    def submit(self, function: Callable[[Task], Result], task: Task) -> Future[Result]:
        """See `Pool`."""
        future: Future[Result] = self._executor.submit(function, task)
        return future

    def renew(self) -> None:
        """Dask replaces workers itself."""

    def close(self) -> None:
        """See `Pool`."""
        self._client.close()
