"""Processes that others began."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence

import psutil


def descendants(pid: int) -> list[psutil.Process]:
    """All that a process has begun and what these have."""
    with contextlib.suppress(psutil.NoSuchProcess):
        return psutil.Process(pid).children(recursive=True)
    return []


def wait_gone(processes: Sequence[psutil.Process], seconds: float) -> list[str]:
    """Wait for processes to end; the command lines of those that do not."""
    _, left = psutil.wait_procs(list(processes), timeout=seconds)
    told = []
    for process in left:
        with contextlib.suppress(psutil.NoSuchProcess):
            if process.status() != psutil.STATUS_ZOMBIE:
                told.append(" ".join(process.cmdline())[-200:])
    return told
