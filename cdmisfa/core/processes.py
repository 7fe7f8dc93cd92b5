"""Processes of this machine that compute for this one, and end with it."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from multiprocessing.reduction import ForkingPickler
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

Result = TypeVar("Result")

Call = tuple[Callable[..., Any], tuple[Any, ...]]

ENDED = "a worker process ended"


class Workers:
    """Processes that are started as they are needed.

    They end at `close`, and when this process is killed, whatever they are doing. A terminal's
    Ctrl-C, or its end, is for this process only. When one dies, what all of them were doing ends
    with `concurrent.futures.process.BrokenProcessPool`.

    Each has a pipe of its own, of which nobody else has an end: what one was sending when it was
    killed neither keeps another from sending nor is waited for.

    Args:
        jobs: how many.
        start: called first in each of them; importable by name, as is all that they compute.
        arguments: of `start`.
        environment: variables of theirs, set before they import anything.
    """

    def __init__(
        self,
        jobs: int,
        start: Callable[..., None] | None = None,
        arguments: tuple[Any, ...] = (),
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self._jobs = jobs
        self._start: Call | None = None if start is None else (start, arguments)
        self._environment = dict(environment or {})
        self._lock = threading.Lock()
        self._unfinished = 0
        self._ended = ""
        self._tasks: SimpleQueue[tuple[Future[Any], Call] | None] = SimpleQueue()
        self._workers: list[tuple[SpawnProcess, threading.Thread]] = []

    def submit(self, function: Callable[..., Result], *arguments: Any) -> Future[Result]:
        """Have one of them call a function."""
        future: Future[Result] = Future()
        with self._lock:
            if self._ended:
                future.set_exception(BrokenProcessPool(self._ended))
                return future
            self._unfinished += 1
            if len(self._workers) < min(self._unfinished, self._jobs):
                self._begin_one()
            self._tasks.put((future, (function, arguments)))
        return future

    def close(self) -> None:
        """End them all at once, whatever they are doing; harmless when called twice."""
        self._end()
        for process, thread in self._workers:
            thread.join()
            process.join()

    def _begin_one(self) -> None:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_compute, args=(theirs, self._environment), daemon=True)
        thread = threading.Thread(target=self._serve, args=(ours,), daemon=True)
        resource_tracker.ensure_running()  # when it begins it lets Ctrl-C through again
        with _inherited():
            process.start()
            thread.start()
        theirs.close()
        self._workers.append((process, thread))

    def _serve(self, pipe: Connection) -> None:
        """Hand tasks to one process until it ends; the thread that belongs to it."""
        with pipe:
            try:
                if self._start is not None:
                    _ask(pipe, self._start)
            except BaseException as error:
                self._end(f"{ENDED}: {error}")
            while (task := self._tasks.get()) is not None:
                future, call = task
                if future.set_running_or_notify_cancel():
                    try:
                        future.set_result(_ask(pipe, call))
                    except _DiedError:
                        future.set_exception(BrokenProcessPool(ENDED))
                        self._end()
                    except BaseException as error:
                        future.set_exception(error)
                with self._lock:
                    self._unfinished -= 1

    def _end(self, why: str = ENDED) -> None:
        with self._lock:
            self._ended = self._ended or why
            for process, _ in self._workers:
                process.kill()
            with contextlib.suppress(Empty):
                while True:
                    task = self._tasks.get_nowait()
                    if task is not None and task[0].set_running_or_notify_cancel():
                        task[0].set_exception(BrokenProcessPool(self._ended))
            for _ in self._workers:
                self._tasks.put(None)


class _DiedError(Exception):
    """The process at the other end of a pipe is no more."""


def _ask(pipe: Connection, call: Call) -> Any:
    """What a call comes to in the process at the other end of a pipe.

    Raises:
        _DiedError: it ended before it answered.
        BaseException: of the call, or of what cannot be sent.
    """
    message = ForkingPickler.dumps(call)
    try:
        pipe.send_bytes(message)
        answer = pipe.recv_bytes()
    except (EOFError, OSError) as error:
        raise _DiedError from error
    failed, value = pickle.loads(answer)
    if failed:
        raise value
    return value


@contextlib.contextmanager
def _inherited() -> Iterator[None]:
    """What a process that is started meanwhile inherits: no signal of a terminal, no main module.

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


def _compute(pipe: Connection, environment: Mapping[str, str]) -> None:
    """Answer what is asked through a pipe; what a worker does."""
    os.environ.update(environment)
    calls: SimpleQueue[bytes] = SimpleQueue()
    threading.Thread(target=_receive, args=(pipe, calls), daemon=True).start()
    with contextlib.suppress(BrokenPipeError, ConnectionResetError):
        while True:
            pipe.send_bytes(_answer(calls.get()))


def _receive(pipe: Connection, calls: SimpleQueue[bytes]) -> None:
    """Take calls while others are computed, and so see at once when there is nobody to answer."""
    with contextlib.suppress(EOFError, OSError):
        while True:
            calls.put(pipe.recv_bytes())
    os._exit(1)


def _answer(message: bytes) -> memoryview:
    try:
        function, arguments = pickle.loads(message)
        return ForkingPickler.dumps((False, function(*arguments)))
    except BaseException as error:
        error.add_note("".join(traceback.format_exception(error)))
        try:
            pickle.loads(message := bytes(ForkingPickler.dumps((True, error))))
        except Exception:
            return ForkingPickler.dumps((True, RuntimeError(f"{type(error).__name__}: {error}")))
        return memoryview(message)
