"""Waiting for what another process or thread does."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable
from typing import Any


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
