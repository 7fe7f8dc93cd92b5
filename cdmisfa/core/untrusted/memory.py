"""One memory budget for what decodes files of others, in libraries that know no limit.

JSON is held to a length instead: what it says takes up to twenty times as much memory.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import sys
import threading
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, Final

BUDGET: Final = 336 * 1024 * 1024
"""Bytes that decoding may take; with those of a whole command these are less than 512 MB."""

MAX_JSON: Final = 4 * 1024 * 1024
"""Longest JSON text that is read where nothing else is said, in bytes."""

MAX_LIST: Final = 16 * 1024 * 1024
"""Longest JSON text of a list that grows with what was asked for, in bytes."""

_STATM: Final = Path("/proc/self/statm")
_PAGE: Final = os.sysconf("SC_PAGE_SIZE") if sys.platform == "linux" else 0
_DATA: Final = 5
"""Which number of `_STATM` counts the pages that `RLIMIT_DATA` limits."""
_LOCK: Final = threading.Lock()
_THREAD: Final = threading.local()
_threads = 0
_before = (0, 0)


@contextlib.contextmanager
def budget(size: int = BUDGET) -> Iterator[None]:
    """Give this process so much more memory than it has, and no more, while the body runs.

    What asks for more gets a MemoryError, as where there is no more, and before it takes any. A
    body within another has what is left of the other's. Of bodies in several threads the largest
    limit holds. Where the system knows no such limit, as on others than Linux, there is none.

    Args:
        size: bytes.
    """
    if sys.platform != "linux" or getattr(_THREAD, "inside", False):
        yield
        return
    _limit(size)
    _THREAD.inside = True
    try:
        yield
    finally:
        _THREAD.inside = False
        _free()


def data_bytes() -> int:
    """What of this process's memory `budget` counts, in bytes; 0 where there is no budget."""
    if sys.platform != "linux":
        return 0
    return int(os.pread(_statm(os.getpid()), 200, 0).split()[_DATA]) * _PAGE


@cache
def _statm(process: int) -> int:
    """`_STATM` of a process, open: it is read for every image."""
    return os.open(_STATM, os.O_RDONLY)


def parse_json(text: str | bytes, most: int = MAX_JSON) -> Any:
    """The value of a JSON text.

    Raises:
        ValueError: it is none, nested too deep or longer than `most`.
    """
    if len(text) > most:
        raise ValueError(f"{len(text)} bytes of JSON, above the limit of {most}")
    collecting = gc.isenabled()
    gc.disable()  # what is made of JSON has no cycles, and looking for some takes most of the time
    try:
        return json.loads(text if isinstance(text, str) else text.decode("utf-8"))
    except RecursionError:
        raise ValueError("it is nested too deep") from None
    finally:
        if collecting:
            gc.enable()


def _limit(size: int) -> None:
    global _threads, _before
    import resource

    with _LOCK:
        now = resource.getrlimit(resource.RLIMIT_DATA)
        if not _threads:
            _before = now
        most = data_bytes() + size
        most = max(most, now[0]) if _threads else most
        own = _before[0]
        if own != resource.RLIM_INFINITY:
            most = min(most, own)
        resource.setrlimit(resource.RLIMIT_DATA, (most, _before[1]))
        _threads += 1


def _free() -> None:
    global _threads
    import resource

    with _LOCK:
        _threads -= 1
        if not _threads:
            resource.setrlimit(resource.RLIMIT_DATA, _before)
