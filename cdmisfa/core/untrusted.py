"""Safe reading of untrusted files: regular files only, with limits of size, time and memory.

`budget` limits the memory of libraries that decode files and have no limit of their own. For JSON a
limit of the length serves instead: its values take up to twenty times as much memory.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import stat
import sys
import threading
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, Final

from cdmisfa.core.errors import LogDamagedError, UsageError

# Memory that decoding may allocate, in bytes. Set so that a whole command stays below 512 MB. A
# smaller budget refuses more logs as too large, a larger one lets a hostile file take more memory.
BUDGET: Final = 336 * 1024 * 1024

# Longest JSON text in bytes: in general, and for lists that grow with the number of logs or tasks.
MAX_JSON: Final = 4 * 1024 * 1024
MAX_LIST: Final = 16 * 1024 * 1024

_LOCK: Final = threading.Lock()
_THREAD: Final = threading.local()
_budgets = 0  # number of bodies of `budget` that run now
_before = (0, 0)  # limits of the process before the first of them


def printable(text: str) -> str:
    """Return a text in which every character is visible and no terminal control sequence is left.

    Control characters, line breaks and marks of text direction are escaped as in a Python string.
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


@contextlib.contextmanager
def budget(size: int = BUDGET) -> Iterator[None]:
    """Limit the memory that this process can allocate while the body runs.

    An allocation beyond the limit raises a MemoryError. A nested call keeps the limit of the outer
    one. With calls in several threads the largest limit applies. Only Linux has such a limit.

    Args:
        size: bytes to allocate beyond the memory that the process has now.
    """
    global _budgets, _before
    if sys.platform != "linux" or getattr(_THREAD, "inside", False):
        yield
        return
    import resource

    with _LOCK:
        now = resource.getrlimit(resource.RLIMIT_DATA)
        limit = data_bytes() + size
        if _budgets:
            limit = max(limit, now[0])
        else:
            _before = now
        if _before[0] != resource.RLIM_INFINITY:
            limit = min(limit, _before[0])
        resource.setrlimit(resource.RLIMIT_DATA, (limit, _before[1]))
        _budgets += 1
    _THREAD.inside = True
    try:
        yield
    finally:
        _THREAD.inside = False
        with _LOCK:
            _budgets -= 1
            if not _budgets:
                resource.setrlimit(resource.RLIMIT_DATA, _before)


def data_bytes() -> int:
    """Return the bytes of this process's memory that `budget` limits; 0 if there is no limit."""
    if sys.platform != "linux":
        return 0
    pages = os.pread(_statm(os.getpid()), 200, 0).split()[5]
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


@cache
def _statm(process: int) -> int:
    """Open the memory statistics of a process, once, since they are read for every image."""
    return os.open("/proc/self/statm", os.O_RDONLY)


def parse_json(text: str | bytes, limit: int = MAX_JSON) -> Any:
    """Return the value of a JSON text.

    Raises:
        ValueError: the text is not JSON, nested too deep, or longer than `limit` bytes.
    """
    if len(text) > limit:
        raise ValueError(f"{len(text)} bytes of JSON, above the limit of {limit}")
    collecting = gc.isenabled()
    gc.disable()  # JSON values have no cycles, and looking for them takes most of the time
    try:
        return json.loads(text if isinstance(text, str) else text.decode("utf-8"))
    except RecursionError:
        raise ValueError("it is nested too deep") from None
    finally:
        if collecting:
            gc.enable()


def check_regular(path: Path, limit: int | None = None) -> None:
    """Check that a path is a regular file that can be read.

    Raises:
        UsageError: it is not, or it has more than `limit` bytes.
    """
    os.close(file_number(path, limit))


def file_number(path: Path, limit: int | None = None) -> int:
    """Open a file as `open_regular` does; raise a UsageError if it cannot be opened."""
    try:
        return open_regular(path, limit)
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from None


def open_regular(path: Path, limit: int | None = None) -> int:
    """Open a regular file for reading, and return its descriptor; never wait as for a pipe.

    Raises:
        OSError: the file cannot be opened.
        UsageError: the path is not a regular file, or has more than `limit` bytes.
    """
    status = os.stat(path)  # before opening, which has effects on some devices
    if not stat.S_ISREG(status.st_mode):
        raise UsageError(f"{path}: not a regular file")
    if limit is not None and status.st_size > limit:
        raise UsageError(f"{path}: {status.st_size} bytes, above the limit of {limit}")
    return os.open(path, os.O_RDONLY | os.O_NONBLOCK)


@contextlib.contextmanager
def opened_regular(path: Path, limit: int | None = None) -> Iterator[BinaryIO]:
    """Open a regular file for reading; raise errors as `read_regular`, also in the body."""
    number = file_number(path, limit)
    try:
        with open(number, "rb") as file:
            yield file
    except OSError as error:
        raise LogDamagedError(f"{path} cannot be read: {error.strerror or error}") from error


def read_regular(path: Path, limit: int) -> bytes:
    """Return the bytes of a regular file; never wait as for a pipe, never read beyond the limit.

    Raises:
        UsageError: the path is not a readable regular file, or has more than `limit` bytes.
        LogDamagedError: reading fails.
    """
    with opened_regular(path, limit) as file:
        return file.read(limit) or b""  # read() returns None for endless files, as in /proc


def read_json(path: Path, remedy: str, *, limit: int = MAX_JSON) -> Any:
    """Return the document in a JSON file.

    Args:
        path: a regular file.
        remedy: what to do if it is damaged, the end of the error.
        limit: largest size (bytes).

    Raises:
        UsageError: the path is not a readable regular file, or it is too large.
        LogDamagedError: the file is not JSON, or reading fails.
    """
    data = read_regular(path, limit)
    try:
        return parse_json(data, limit)
    except ValueError as error:
        raise LogDamagedError(f"{path} is damaged: {remedy}") from error
