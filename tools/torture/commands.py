"""Commands as cases run them: in this process, which is the case's own, or as a process."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from cdmisfa.cli.interrupts import SIGNALS

from .outcomes import CLEAR_ERROR, HANG, RIGHT, TRACEBACK, WRONG, Defect, Outcome

ROOT = Path(__file__).resolve().parents[2]
LIMIT = 5.0
"""Seconds in which what was told to end, or was given something broken, must have ended."""

CODES = (0, 1, 2, 3, 4, 129, 130, 143)
ERRORS = (1, 2, 3, 4)
UNCLEAR = re.compile(
    r"Traceback \(most recent|cdmisfa: unexpected \w+|Exception ignored|Fatal Python"
)


@dataclass(frozen=True, slots=True)
class Ran:
    """A command that ended.

    Attributes:
        seconds: it took; of this process alone, where it ran in it.
    """

    words: tuple[str, ...]
    code: int
    out: str
    err: str
    seconds: float

    @property
    def line(self) -> str:
        """The command as one would type it."""
        return f"cdmisfa {shlex.join(self.words)}"

    @property
    def json(self) -> Any:
        """The document that it printed."""
        return json.loads(self.out)

    def told(self) -> str:
        """Its last line on stderr."""
        return next(reversed(self.err.strip().splitlines()), "")[:300]


def here(*words: object) -> Ran:
    """Run a command in this process, as `main` does; its streams go to files meanwhile."""
    from cdmisfa.cli import run

    args = tuple(map(str, words))
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        with _instead(1, out.fileno()), _instead(2, err.fileno()):
            began, began_wall = time.process_time(), time.monotonic()
            code = run(list(args))
            seconds = time.process_time() - began
            # what waits uses no time of a processor, and others may use it meanwhile
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
    kept = os.dup(number)
    os.dup2(other, number)
    try:
        yield
    finally:
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
        os.dup2(kept, number)
        os.close(kept)


def environment() -> dict[str, str]:
    """That of a command which is run from the code here."""
    return {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"}


class Process:
    """A command as a process of its own; its streams are files beside `folder`.

    Args:
        folder: where it is begun.
        words: of the command.
        shell: redirections.
        more: variables of its environment.
    """

    def __init__(
        self,
        folder: Path,
        *words: object,
        shell: str = "",
        more: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        self.words = tuple(map(str, words))
        self._environment = environment() | more
        self.code: int | None = None
        streams = Path(tempfile.mkdtemp(dir=folder.parent))
        self._out, self._err = streams / "out", streams / "err"
        with self._out.open("w") as out, self._err.open("w") as err:
            self.pid = self._begin(folder, out.fileno(), err.fileno(), shell)
        self._began = time.monotonic()

    def _begin(self, folder: Path, out: int, err: int, shell: str) -> int:
        line = [sys.executable, "-m", "cdmisfa", *self.words]
        if shell:
            line = ["sh", "-c", f'exec "$@" {shell}', "sh", *line]
        process = subprocess.Popen(
            line,
            cwd=folder,
            env=self._environment,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=err,
        )
        process.returncode = 0  # it is waited for here, and by nobody else
        return process.pid

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

    def wait(self, seconds: float, group: str, why: str = "") -> Ran:
        """What it came to.

        Raises:
            Defect: it hangs.
        """
        if not until(lambda: not self.running, seconds):
            self.send(signal.SIGKILL)
            until(lambda: not self.running, 10)
            ran = self.ran()
            what = f"{ran.line} {why} did not end within {seconds:g} s: {ran.told()}"
            raise Defect(HANG, group, what)
        return self.ran()

    def ran(self) -> Ran:
        """What it has said until now, and its code, once it has ended."""
        seconds = time.monotonic() - self._began
        texts = [path.read_text(errors="replace") for path in (self._out, self._err)]
        return Ran(self.words, -signal.SIGKILL if self.code is None else self.code, *texts, seconds)


class Fork(Process):
    """The same, forked off this process, so that nothing is imported again.

    Args:
        folder: as for `Process`, as are `words`.
        tweak: called there first.
    """

    def __init__(self, folder: Path, *words: object, tweak: Callable[[], None] = int) -> None:
        self._tweak = tweak
        super().__init__(folder, *words)

    def _begin(self, folder: Path, out: int, err: int, shell: str) -> int:
        pid = os.fork()
        if pid:
            return pid
        code = 70
        try:
            os.chdir(folder)
            os.dup2(out, 1)
            os.dup2(err, 2)
            for number in SIGNALS:  # what comes after the command has ended
                signal.signal(number, lambda *_: None)
            self._tweak()
            from cdmisfa.cli import run

            code = run(list(self.words))
            sys.stdout.flush()
            sys.stderr.flush()
        except BaseException:
            os.write(2, traceback.format_exc().encode())
        finally:
            os._exit(code)


def call(folder: Path, *words: object, seconds: float = 110, group: str = "setup") -> Ran:
    """Run a command as a process, to its end."""
    return Process(folder, *words).wait(seconds, group)


def must(folder: Path, *words: object, seconds: float = 600) -> Ran:
    """Run a command that has to succeed.

    Raises:
        Defect: it does not.
    """
    ran = call(folder, *words, seconds=seconds)
    if ran.code != 0:
        raise Defect(WRONG, "setup", f"{ran.line}: exit {ran.code}: {ran.told()}")
    return ran


def judge(ran: Ran, group: str, *, limit: float | None = LIMIT) -> Outcome:
    """Whether a command gave a result or one clear line, in time.

    Raises:
        Defect: neither.
    """
    if UNCLEAR.search(ran.err) or ran.code not in CODES:
        text = ran.told() if ran.code in CODES else f"exit {ran.code}: {ran.told()}"
        raise Defect(TRACEBACK, group, f"{ran.line}: {text}")
    if limit is not None and ran.seconds > limit:
        raise Defect(HANG, group, f"{ran.line}: {ran.seconds:.1f} s")
    if ran.code in ERRORS:
        # 3 and 4 may also be said in what a command prints
        if not ran.err.strip() and not (ran.code in (1, 3, 4) and ran.out.strip()):
            raise Defect(TRACEBACK, group, f"{ran.line}: exit {ran.code} without a word")
        return Outcome(CLEAR_ERROR, group, ran.told())
    return Outcome(RIGHT, group)


def worst(outcomes: Sequence[Outcome]) -> Outcome:
    """An error, if there is one, else what is right."""
    return next((o for o in outcomes if o.kind == CLEAR_ERROR), outcomes[0])


def until(ready: Callable[[], bool], seconds: float) -> bool:
    """Wait for something; whether it came."""
    deadline = time.monotonic() + seconds
    while not ready():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.01)
    return True
