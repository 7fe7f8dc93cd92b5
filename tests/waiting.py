"""Commands in processes of their own, and waiting for what another process or thread does."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from typing import Any


class Clock:
    """A clock that only sleeping moves."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        """Its seconds."""
        return self.now

    def sleep(self, seconds: float) -> None:
        """Let seconds pass."""
        self.now += seconds


def python(*words: object, **how: Any) -> subprocess.CompletedProcess[str]:
    """What a Python process of its own left that was given these words."""
    how = {"capture_output": True, "text": True, "timeout": 300, **how}
    return subprocess.run([sys.executable, *map(str, words)], **how)


@contextlib.contextmanager
def running(*words: object, **how: Any) -> Iterator[subprocess.Popen[str]]:
    """Such a process, which is killed where it goes on at the end."""
    how = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, **how}
    with subprocess.Popen([sys.executable, *map(str, words)], **how) as process:
        try:
            yield process
        finally:
            process.kill()


def started(*words: object, **environment: str) -> AbstractContextManager[subprocess.Popen[str]]:
    """The command line in such a process."""
    return running("-m", "cdmisfa", *words, env={**os.environ, **environment})


def wait_for(
    ready: Callable[[], object], seconds: float, process: subprocess.Popen[Any] | None = None
) -> None:
    """Wait until something has happened; it fails where that takes longer.

    Args:
        ready: whether it has.
        seconds: at most.
        process: who does it; it fails at once where this has ended.
    """
    deadline = time.monotonic() + seconds
    while not ready():
        assert process is None or process.poll() is None, process.communicate(timeout=10)
        assert time.monotonic() < deadline
        time.sleep(0.005)


def listens(port: int) -> bool:
    """Return whether a server listens at a port of this machine."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0
