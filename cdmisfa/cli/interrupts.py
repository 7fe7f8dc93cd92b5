"""Ctrl-C, SIGTERM and SIGHUP: files are finished on the way out, and the exit code says why."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Stop:
    """Whether a signal has come; callable, as a loop's `stop`."""

    def __init__(self) -> None:
        self.number: int = 0

    def __call__(self) -> bool:
        """Whether to stop."""
        return self.number != 0

    @property
    def exit_code(self) -> int:
        """Of a stopped command: 130 for Ctrl-C, 143 for SIGTERM, 129 for SIGHUP."""
        return 128 + (self.number or signal.SIGINT)


@contextmanager
def interruptible() -> Iterator[Stop]:
    """Make each of `SIGNALS` raise KeyboardInterrupt while the body runs."""
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
    stop, outer = Stop(), {int(number): signal.getsignal(number) for number in SIGNALS}

    def ask(number: int, frame: FrameType | None) -> None:
        if stop():
            if callable(handle := outer[number]):  # which knows the exit code
                handle(number, frame)
            raise KeyboardInterrupt
        stop.number = number
        # not print: the signal may have come in the middle of one
        os.write(2, notice.encode())

    with _handled_by(ask):
        yield stop


@contextmanager
def _handled_by(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    def handle(number: int, frame: FrameType | None) -> None:
        _let_go_of_terminal()
        handler(number, frame)

    # nohup has SIGHUP ignored
    kept = {signal.SIGHUP} if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN else set()
    try:
        before = {number: signal.signal(number, handle) for number in {*SIGNALS} - kept}
    except ValueError:  # not the main thread: signals are not ours to handle
        yield
        return
    try:
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, previous)


def _let_go_of_terminal() -> None:
    """Let standard streams of a terminal that is no more lead nowhere: to write there fails."""
    for number in (1, 2):
        try:
            os.write(number, b"")
        except OSError:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, number)
            os.close(nowhere)
