"""Ctrl-C, SIGTERM and SIGHUP: finish files, and exit with the code of the signal."""

from __future__ import annotations

import atexit
import os
import signal
import sys
import threading
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

# Seconds after which an interrupt is sent again that Python dropped. Long enough for the destructor
# that dropped it to return, too short for a person to notice.
RESEND_DELAY = 0.02


class Stop:
    """Request of a signal to stop; callable, as the `stop` of a loop.

    Attributes:
        number: number of the last signal, 0 for none.
        ended: whether the work has ended, so that a signal changes nothing.
    """

    def __init__(self) -> None:
        self.number: int = 0
        self.ended = False

    def __call__(self) -> bool:
        """Return whether a signal has arrived."""
        return self.number != 0

    @property
    def exit_code(self) -> int:
        """Exit code of a stopped command: 130 for Ctrl-C, 143 for SIGTERM, 129 for SIGHUP."""
        return 128 + (self.number or signal.SIGINT)


@contextmanager
def interruptible() -> Iterator[Stop]:
    """Make each of `SIGNALS` raise KeyboardInterrupt while the body runs."""
    stop = Stop()

    def interrupt(number: int, frame: FrameType | None) -> None:
        if not stop.ended:
            stop.number = number
            raise KeyboardInterrupt

    with _handled_by(interrupt), _resending_dropped(stop):
        yield stop


def exit_on_signals(code: int | None = None) -> None:
    """Make signals exit this process at once from now on, unless another handler replaces this one.

    Args:
        code: exit code, without a message; None to print "interrupted" and exit with the code of
            the signal.
    """

    def exit_now(number: int, frame: FrameType | None) -> None:
        if code is None:
            with suppress(OSError):
                os.write(2, b"cdmisfa: interrupted\n")
        os._exit(128 + number if code is None else code)

    for number in {*SIGNALS} - _ignored():
        signal.signal(number, exit_now)


@contextmanager
def stoppable(
    notice: str = "finishing; press Ctrl-C again to stop at once\n",
    signals: Collection[signal.Signals] = SIGNALS,
) -> Iterator[Stop]:
    """Let the body finish its step at the first signal, and print `notice`; the second interrupts.

    Yields:
        A `Stop` that becomes true with the first signal.
    """
    stop, outer = Stop(), {int(number): signal.getsignal(number) for number in signals}

    def request_stop(number: int, frame: FrameType | None) -> None:
        if stop.number:
            if callable(handle := outer[number]):  # it stores the number, for the exit code
                handle(number, frame)
            raise KeyboardInterrupt
        stop.number = number
        # not print(), which cannot be called while it prints
        os.write(2, notice.encode())

    with _handled_by(request_stop, signals):
        yield stop


def ignore_signals_at_exit() -> None:
    """Ignore signals while Python shuts down, so that they cannot change the exit code."""
    for number in SIGNALS:
        atexit.register(signal.signal, number, signal.SIG_IGN)


@contextmanager
def _handled_by(
    handler: Callable[[int, FrameType | None], None],
    signals: Collection[signal.Signals] = SIGNALS,
) -> Iterator[None]:
    def handle(number: int, frame: FrameType | None) -> None:
        _leave_closed_terminal()
        handler(number, frame)

    try:
        before = {number: signal.signal(number, handle) for number in {*signals} - _ignored()}
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
def _resending_dropped(stop: Stop) -> Iterator[None]:
    """Send an interrupt again that Python dropped in a destructor or a callback of C.

    Other errors of destructors after an interrupt are not printed: they are its consequences.
    """
    before = sys.unraisablehook

    def handle_unraisable(error: Any) -> None:
        if not stop():
            before(error)
        elif error.exc_type is KeyboardInterrupt and not stop.ended:
            timer = threading.Timer(RESEND_DELAY, os.kill, (os.getpid(), stop.number))
            timer.daemon = True
            timer.start()

    sys.unraisablehook = handle_unraisable
    try:
        yield
    finally:
        sys.unraisablehook = before


def _leave_closed_terminal() -> None:
    """Point stdout and stderr to /dev/null if their terminal was closed: writing would fail."""
    for number in (1, 2):
        try:
            os.write(number, b"")
        except OSError:
            devnull = os.open(os.devnull, os.O_WRONLY)
            os.dup2(devnull, number)
            os.close(devnull)
