"""Run commands in the process of a case, or in a fork of it, and judge how they end."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shlex
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cdmisfa.core.interrupts import SIGNALS

from .cases import REFUSED, RIGHT, Defect

ROOT = Path(__file__).resolve().parents[2]
LIMIT = 5.0
"""Seconds after which a command that was asked to end, or got a broken file, must have ended."""

CODES = (0, 1, 2, 3, 4, 129, 130, 143)
ERRORS = (1, 2, 3, 4)
UNCLEAR = re.compile(
    r"Traceback \(most recent|cdmisfa: unexpected \w+|Exception ignored|Fatal Python"
)


@dataclass(frozen=True, slots=True)
class Ran:
    """A command that ended; `seconds` counts the process alone where it ran in this one."""

    words: tuple[str, ...]
    code: int
    out: str
    err: str
    seconds: float

    @property
    def json(self) -> Any:
        """The document that the command printed."""
        return json.loads(self.out)

    def __str__(self) -> str:
        """Return the command, its exit code and its last line on stderr."""
        last = next(reversed(self.err.strip().splitlines()), "")[:300]
        return f"cdmisfa {shlex.join(self.words)}: exit {self.code}: {last}"


def here(*words: object) -> Ran:
    """Run a command in this process; its streams go to files meanwhile."""
    from cdmisfa.cli import run

    args = tuple(map(str, words))
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        with _instead(1, out.fileno()), _instead(2, err.fileno()):
            began, began_wall = time.process_time(), time.monotonic()
            code = run(list(args))
            seconds = time.process_time() - began
            # A command that waits uses no processor time, and other cases may use it meanwhile.
            if (wall := time.monotonic() - began_wall) > 4 * LIMIT:
                seconds = wall
        out.seek(0)
        err.seek(0)
        texts = [file.read().decode(errors="replace") for file in (out, err)]
    return Ran(args, code, texts[0], texts[1], seconds)


@contextlib.contextmanager
def _instead(number: int, other: int) -> Iterator[None]:
    stream = sys.stdout if number == 1 else sys.stderr
    stream.flush()
    saved = os.dup(number)
    os.dup2(other, number)
    try:
        yield
    finally:
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
        os.dup2(saved, number)
        os.close(saved)


def must(*words: object, done: tuple[int, ...] = (0,)) -> Ran:
    """Run a command in this process that has to succeed."""
    ran = here(*words)
    if ran.code not in done:
        raise Defect(f"preparing: {ran}")
    return ran


class Fork:
    """A command in a fork of this process, with its streams in files beside `folder`.

    Args:
        folder: working folder.
        words: of the command.
        tweak: called before the command.
    """

    def __init__(self, folder: Path, *words: object, tweak: Callable[[], None]) -> None:
        self.words = tuple(map(str, words))
        self.code: int | None = None
        streams = Path(tempfile.mkdtemp(dir=folder.parent))
        self._out, self._err = streams / "out", streams / "err"
        self._began = time.monotonic()
        with self._out.open("w") as out, self._err.open("w") as err:
            self.pid = os.fork()
            if self.pid == 0:
                self._in_child(folder, out.fileno(), err.fileno(), tweak)

    def _in_child(self, folder: Path, out: int, err: int, tweak: Callable[[], None]) -> None:
        code = 70
        try:
            os.chdir(folder)
            os.dup2(out, 1)
            os.dup2(err, 2)
            for number in SIGNALS:  # for a signal that comes after the command has ended
                signal.signal(number, lambda *_: None)
            tweak()
            from cdmisfa.cli import run

            code = run(list(self.words))
            sys.stdout.flush()
            sys.stderr.flush()
        except BaseException:
            os.write(2, traceback.format_exc().encode())
        finally:
            os._exit(code)

    @property
    def running(self) -> bool:
        """Whether it has not ended."""
        if self.code is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self.code = os.waitstatus_to_exitcode(status)
        return self.code is None

    def send(self, number: int) -> None:
        """Send it a signal, unless it has ended."""
        if self.running:
            os.kill(self.pid, number)

    def wait(self, seconds: float, why: str) -> Ran:
        """Wait for its end; one that hangs is a defect."""
        if hangs := not until(lambda: not self.running, seconds):
            self.send(signal.SIGKILL)
            until(lambda: not self.running, 10)
        texts = [path.read_text(errors="replace") for path in (self._out, self._err)]
        code = -signal.SIGKILL if self.code is None else self.code
        ran = Ran(self.words, code, *texts, time.monotonic() - self._began)
        if hangs:
            raise Defect(f"no end within {seconds:g} s, {why}: {ran}")
        return ran


def judge(ran: Ran, *, limit: float | None = LIMIT) -> str:
    """Return RIGHT or REFUSED for a result or one clear line in time; all else is a defect."""
    if UNCLEAR.search(ran.err) or ran.code not in CODES:
        raise Defect(f"no clear line: {ran}")
    if limit is not None and ran.seconds > limit:
        raise Defect(f"{ran.seconds:.1f} s: {ran}")
    if ran.code in ERRORS:
        # 1, 3 and 4 may also be explained on stdout.
        if not ran.err.strip() and not (ran.code in (1, 3, 4) and ran.out.strip()):
            raise Defect(f"no message: {ran}")
        return REFUSED
    return RIGHT


def until(ready: Callable[[], bool], seconds: float) -> bool:
    """Wait for a condition; return whether it came true."""
    deadline = time.monotonic() + seconds
    while not ready():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.01)
    return True
