"""Tasks for the engines' workers; imports nothing heavy, because every worker imports it."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path
from typing import Any


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


def die_while_sending(size: int, seconds: float) -> bytes:
    """A task whose worker is killed -9 so many seconds after it began to send its result."""
    threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGKILL)).start()
    return bytes(size)


def apply_or_die(modules: Any, name: str, files: list[str], *how: Any) -> Any:
    """Apply modules to a log, unless that kills its worker, as its name says; notes each death."""
    from cdmisfa.experiments.apply_logs import apply_to_log

    if "deadly" in name:
        with open(files[0] + ".deaths", "a") as file:
            file.write(".")
        os.kill(os.getpid(), signal.SIGKILL)
    return apply_to_log(modules, name, files, *how)
