"""Reading what others may have written: which files, how long, and with how much memory.

One memory budget is for what decodes files of others, in libraries that know no limit. JSON is
held to a length instead: what it says takes up to twenty times as much memory.
"""

from __future__ import annotations

import contextlib
import errno
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

BUDGET: Final = 336 * 1024 * 1024
"""Bytes that decoding may take; with those of a whole command these are less than 512 MB."""

MAX_JSON: Final = 4 * 1024 * 1024
"""Longest JSON text that is read where nothing else is said, in bytes."""

MAX_LIST: Final = 16 * 1024 * 1024
"""Longest JSON text of a list that grows with what was asked for, in bytes."""

_STATM: Final = Path("/proc/self/statm")
_PAGE: Final = os.sysconf("SC_PAGE_SIZE") if sys.platform == "linux" else 0
_DATA: Final = 5
"""Column of `_STATM`: the pages that `RLIMIT_DATA` limits."""
_LOCK: Final = threading.Lock()
_THREAD: Final = threading.local()
_threads = 0
_before = (0, 0)


def printable(text: str) -> str:
    """A text of which a terminal shows every character and obeys none.

    What does not print by itself, as controls, line breaks and marks that turn text around, is
    written as in a Python string.
    """
    if text.isprintable():
        return text
    letters = (c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    return "".join(letters)


@contextlib.contextmanager
def budget(size: int = BUDGET) -> Iterator[None]:
    """Limit this process to so much more memory than it has while the body runs.

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
    """Bytes of this process's memory that `budget` limits; 0 where there is no such limit."""
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


def check_regular(path: Path, limit: int | None = None) -> None:
    """Refuse a path that is no regular file, or a file that is too large, unopened.

    Raises:
        UsageError: so it is; or it may not be read.
    """
    try:
        _check(path, os.stat(path), limit)
        if not os.access(path, os.R_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    except FileNotFoundError:
        raise UsageError(f"{path}: no regular file (No such file or directory)") from None
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from None


def read_regular(path: Path, limit: int) -> bytes:
    """The bytes of a regular file; never waits as for a pipe, never reads more than the limit.

    Raises:
        UsageError: it is no regular file that may be read, or has more bytes.
        LogDamagedError: the disk does not give it.
    """
    with opened_regular(path, limit) as file:
        return file.read(limit) or b""  # None of what would have to be waited for, as in /proc


@contextlib.contextmanager
def opened_regular(path: Path, limit: int | None = None) -> Iterator[BinaryIO]:
    """A regular file, open to be read; raises as `read_regular` does, in the body, too."""
    check_regular(path, limit)
    try:
        with open(open_regular(path, limit), "rb") as file:
            yield file
    except OSError as error:
        raise LogDamagedError(f"{path} cannot be read: {error.strerror or error}") from error


def open_regular(path: Path, limit: int | None = None) -> int:
    """Open a regular file to be read, by its number; nothing else is opened or waited for.

    Raises:
        OSError: it cannot be opened.
        UsageError: it is no regular file, or has more bytes.
    """
    _check(path, os.stat(path), limit)  # opening alone does something to some devices
    number = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        _check(path, os.fstat(number), limit)
    except BaseException:
        os.close(number)
        raise
    return number


def read_json(path: Path, remedy: str, *, most: int = MAX_JSON) -> Any:
    """The document in a JSON file.

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


_KINDS: Final = {
    stat.S_IFIFO: "a pipe",
    stat.S_IFDIR: "a folder",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def _check(path: Path, found: os.stat_result, limit: int | None) -> None:
    if not stat.S_ISREG(found.st_mode):
        kind = _KINDS.get(stat.S_IFMT(found.st_mode), "something else")
        raise UsageError(f"{path}: no regular file but {kind}, remove it or name another")
    if limit is not None and found.st_size > limit:
        raise UsageError(f"{path}: {found.st_size} bytes, above the limit of {limit}")
