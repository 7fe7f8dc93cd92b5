"""Processes of this machine that compute for this one, and end with it."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor
from multiprocessing.connection import Connection
from typing import Any, TypeVar

Result = TypeVar("Result")


class Workers:
    """Processes that are started as they are needed.

    They end at `close`, and when this process is killed, whatever they are doing. A terminal's
    Ctrl-C is for this process only. When one dies, what all of them were doing ends with
    `concurrent.futures.process.BrokenProcessPool`.

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
        context = multiprocessing.get_context("spawn")
        # A pipe of which this process alone has the other end: it closes however this one ends.
        self._waits, self._ours = context.Pipe(duplex=False)
        self._executor = ProcessPoolExecutor(
            jobs,
            mp_context=context,
            initializer=_begin,
            initargs=(self._waits, dict(environment or {}), start, arguments),
        )

    def submit(self, function: Callable[..., Result], *arguments: Any) -> Future[Result]:
        """Have one of them call a function."""
        with _inherited():
            return self._executor.submit(function, *arguments)

    def close(self, *, finish: bool = False) -> None:
        """End them all; harmless when called twice.

        Args:
            finish: let them finish what they are computing. Whose results are larger than a
                pipe takes at once must: one that ended in the midst of sending would be waited
                for without end.
        """
        if finish:
            self._executor.shutdown(wait=True, cancel_futures=True)
        self._ours.close()
        self._executor.shutdown(wait=True, cancel_futures=True)
        self._waits.close()


@contextlib.contextmanager
def _inherited() -> Iterator[None]:
    """What a process that is started meanwhile inherits: neither Ctrl-C nor the main module.

    The main module is a command or a user's script, which would begin anew in each of them.
    """
    main = sys.modules["__main__"].__dict__
    hidden: dict[str, Any] = {n: main[n] for n in ("__file__", "__spec__") if n in main}
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        main.pop("__file__", None)
        main["__spec__"] = None
        yield
    finally:
        main.update(hidden)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin(
    waits: Connection,
    environment: Mapping[str, str],
    start: Callable[..., None] | None,
    arguments: tuple[Any, ...],
) -> None:
    threading.Thread(target=_end_with, args=(waits,), daemon=True).start()
    os.environ.update(environment)
    if start is not None:
        start(*arguments)


def _end_with(waits: Connection) -> None:
    with contextlib.suppress(EOFError, OSError):
        waits.recv()
    os._exit(1)
