"""Ctrl-C and SIGTERM: files are finished on the way out, and the exit code says why."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stop:
    """Whether a signal has come; callable, as a loop's `stop`."""

    def __init__(self) -> None:
        self.number: int = 0

    def __call__(self) -> bool:
        """Whether to stop."""
        return self.number != 0

    @property
    def exit_code(self) -> int:
        """Exit code of a command that was stopped: 130 for Ctrl-C, 143 for SIGTERM."""
        return 128 + (self.number or signal.SIGINT)


@contextmanager
def interruptible() -> Iterator[Stop]:
    """Make SIGINT and SIGTERM raise KeyboardInterrupt while the body runs."""
    stop = Stop()

    def interrupt(number: int, frame: FrameType | None) -> None:
        stop.number = number
        raise KeyboardInterrupt

    with _handled_by(interrupt):
        yield stop


@contextmanager
def stoppable(
    notice: str = "stopping after this iteration; again to stop at once\n",
) -> Iterator[Stop]:
    """Let the body end its step at the first signal, and say so; the second one interrupts it."""
    stop = Stop()

    def ask(number: int, frame: FrameType | None) -> None:
        if stop():
            raise KeyboardInterrupt
        stop.number = number
        # not print: the signal may have come in the middle of one
        os.write(2, notice.encode())

    with _handled_by(ask):
        yield stop


@contextmanager
def _handled_by(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    try:
        before = {number: signal.signal(number, handler) for number in SIGNALS}
    except ValueError:  # not the main thread: signals are not ours to handle
        yield
        return
    try:
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, previous)
