"""Ctrl-C, SIGTERM and SIGHUP: files are finished on the way out, and the exit code says why."""

from __future__ import annotations

import atexit
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

# Seconds after which an interrupt that was dropped is sent again.
_AGAIN = 0.02


class Stop:
    """Whether a signal has come; callable, as a loop's `stop`.

    Attributes:
        number: number of the last signal, 0 for none.
        ended: True if the work has finished, so that a further signal has no effect.
    """

    def __init__(self) -> None:
        self.number: int = 0
        self.ended = False

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
        if not stop.ended:
            stop.number = number
            raise KeyboardInterrupt

    with _handled_by(interrupt), _not_lost(stop):
        yield stop


def end_at_once(code: int | None = None) -> None:
    """Make signals end this process at once from now on, where nothing else handles them.

    Args:
        code: to end with, without a word; None to say so, and end with that of the signal.
    """

    def end(number: int, frame: FrameType | None) -> None:
        if code is None:
            with suppress(OSError):
                os.write(2, b"cdmisfa: interrupted\n")
        os._exit(128 + number if code is None else code)

    for number in {*SIGNALS} - _ignored():
        signal.signal(number, end)


@contextmanager
def stoppable(notice: str = "finishing what is begun; again to stop at once\n") -> Iterator[Stop]:
    """Let the body finish its step at the first signal, and print `notice`; the second interrupts.

    Yields:
        Becomes true with the first signal.
    """
    stop, outer = Stop(), {int(number): signal.getsignal(number) for number in SIGNALS}

    def ask(number: int, frame: FrameType | None) -> None:
        if stop.number:
            if callable(handle := outer[number]):  # it notes the signal, for the exit code
                handle(number, frame)
            raise KeyboardInterrupt
        stop.number = number
        # not print: the signal may have come in the middle of one
        os.write(2, notice.encode())

    with _handled_by(ask):
        yield stop


def ignore_at_the_end() -> None:
    """Ignore signals while Python shuts down, so that they cannot change the exit code."""
    for number in SIGNALS:
        atexit.register(signal.signal, number, signal.SIG_IGN)


@contextmanager
def _handled_by(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    def handle(number: int, frame: FrameType | None) -> None:
        _let_go_of_terminal()
        handler(number, frame)

    try:
        before = {number: signal.signal(number, handle) for number in {*SIGNALS} - _ignored()}
    except ValueError:  # not the main thread: signals are not ours to handle
        yield
        return
    try:
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, previous)


def _ignored() -> set[signal.Signals]:
    """Return the signals that nohup ignores."""
    return {n for n in (signal.SIGHUP,) if signal.getsignal(n) == signal.SIG_IGN}


@contextmanager
def _not_lost(stop: Stop) -> Iterator[None]:
    """Send an interrupt again that Python dropped in a destructor or a callback of C.

    Errors of destructors of what an interrupt left unfinished are not shown.
    """
    before = sys.unraisablehook

    def dropped(what: Any) -> None:
        if not stop():
            before(what)
        elif what.exc_type is KeyboardInterrupt and not stop.ended:
            again = threading.Timer(_AGAIN, os.kill, (os.getpid(), stop.number))
            again.daemon = True
            again.start()

    sys.unraisablehook = dropped
    try:
        yield
    finally:
        sys.unraisablehook = before


def _let_go_of_terminal() -> None:
    """Point stdout and stderr to /dev/null where their terminal was closed: writing there fails."""
    for number in (1, 2):
        try:
            os.write(number, b"")
        except OSError:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, number)
            os.close(nowhere)
