"""Reading of files that others may have written: which files, how long, with how much memory.

One memory budget is for what decodes files in libraries that know no limit. JSON is held to a
length instead: its values take up to twenty times as much memory.
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

# Bytes that decoding may take; with those of a whole command these are less than 512 MB.
BUDGET: Final = 336 * 1024 * 1024

# Longest JSON text in bytes: in general, and of a list that grows with what was asked for.
MAX_JSON: Final = 4 * 1024 * 1024
MAX_LIST: Final = 16 * 1024 * 1024

_LOCK: Final = threading.Lock()
_THREAD: Final = threading.local()
_budgets = 0
_before = (0, 0)


def printable(text: str) -> str:
    """Return a text of which a terminal shows every character and obeys none.

    Controls, line breaks and marks that turn text around are written as in a Python string.
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


@contextlib.contextmanager
def budget(size: int = BUDGET) -> Iterator[None]:
    """Limit the memory that this process may take while the body runs.

    An allocation beyond it raises a MemoryError, as where there is no more memory. A body within
    another has what is left of the other's. Of bodies in several threads the largest limit holds.
    On systems other than Linux, which know no such limit, there is none.

    Args:
        size: bytes beyond those that the process has.
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
    """Return the bytes of this process's memory that `budget` limits; 0 where there is no limit."""
    if sys.platform != "linux":
        return 0
    pages = os.pread(_statm(os.getpid()), 200, 0).split()[5]
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


@cache
def _statm(process: int) -> int:
    """Open the memory statistics of a process once: they are read for every image."""
    return os.open("/proc/self/statm", os.O_RDONLY)


def parse_json(text: str | bytes, most: int = MAX_JSON) -> Any:
    """Return the value of a JSON text.

    Raises:
        ValueError: it is none, nested too deep or longer than `most`.
    """
    if len(text) > most:
        raise ValueError(f"{len(text)} bytes of JSON, above the limit of {most}")
    collecting = gc.isenabled()
    gc.disable()  # values of JSON have no cycles, and looking for some takes most of the time
    try:
        return json.loads(text if isinstance(text, str) else text.decode("utf-8"))
    except RecursionError:
        raise ValueError("it is nested too deep") from None
    finally:
        if collecting:
            gc.enable()


def check_regular(path: Path, limit: int | None = None) -> None:
    """Refuse a path that is no regular file, a file that is too large, or one without access.

    Raises:
        UsageError: so it is.
    """
    os.close(_number_of(path, limit))


def _number_of(path: Path, limit: int | None) -> int:
    """Open a file as `open_regular`; a file that cannot be opened is a UsageError."""
    try:
        return open_regular(path, limit)
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from None


def open_regular(path: Path, limit: int | None = None) -> int:
    """Open a regular file to be read, by its number; nothing else is opened or waited for.

    Raises:
        OSError: it cannot be opened.
        UsageError: it is no regular file, or has more bytes.
    """
    status = os.stat(path)  # opening alone does something to some devices
    if not stat.S_ISREG(status.st_mode):
        raise UsageError(f"{path}: no regular file")
    if limit is not None and status.st_size > limit:
        raise UsageError(f"{path}: {status.st_size} bytes, above the limit of {limit}")
    return os.open(path, os.O_RDONLY | os.O_NONBLOCK)


@contextlib.contextmanager
def opened_regular(path: Path, limit: int | None = None) -> Iterator[BinaryIO]:
    """Open a regular file to be read; raises as `read_regular` does, in the body, too."""
    number = _number_of(path, limit)
    try:
        with open(number, "rb") as file:
            yield file
    except OSError as error:
        raise LogDamagedError(f"{path} cannot be read: {error.strerror or error}") from error


def read_regular(path: Path, limit: int) -> bytes:
    """Return the bytes of a regular file; never wait as for a pipe, never read beyond the limit.

    Raises:
        UsageError: it is no regular file that may be read, or has more bytes.
        LogDamagedError: the disk does not give it.
    """
    with opened_regular(path, limit) as file:
        return file.read(limit) or b""  # None of files that never end, as in /proc


def read_json(path: Path, remedy: str, *, most: int = MAX_JSON) -> Any:
    """Return the document in a JSON file.

    Args:
        path: a regular file.
        remedy: what to do where it is damaged.
        most: bytes that it may have.

    Raises:
        UsageError: it is another file.
        LogDamagedError: it holds something else, or the disk does not give it.
    """
    data = read_regular(path, most)
    try:
        return parse_json(data, most)
    except ValueError as error:
        raise LogDamagedError(f"{path} is damaged: {remedy}") from error
