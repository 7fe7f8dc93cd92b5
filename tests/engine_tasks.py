"""Tasks for the engines' workers; imports nothing heavy, because every worker imports it."""

from __future__ import annotations

import os
import signal
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
