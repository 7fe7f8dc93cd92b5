"""Tasks for the engines' workers; imports nothing heavy, because every worker imports it."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path


def trace(task: tuple[str, int, str]) -> int:
    """A task that notes each attempt; "once" kills its worker -9 at the first, "always" at all."""
    folder, number, mode = task
    attempts = Path(folder) / str(number)
    with open(attempts, "a") as file:
        file.write(".")
    if mode == "always" or (mode == "once" and attempts.stat().st_size == 1):
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def sleep_for(seconds: float) -> None:
    """A task that takes its time."""
    time.sleep(seconds)


def die_while_sending(size: int) -> bytes:
    """A task whose worker is killed -9 when the first megabyte of its result is on its way."""
    threading.Thread(target=_kill_when_sent, args=(1 << 20,), daemon=True).start()
    return bytes(size)


def _kill_when_sent(size: int) -> None:
    before = _received()
    while _received() < before + size:
        time.sleep(0.001)
    os.kill(os.getpid(), signal.SIGKILL)


def _received() -> int:
    """Bytes that the parent has read: those of a write count when it is over only."""
    return int(Path(f"/proc/{os.getppid()}/io").read_text().split()[1])
