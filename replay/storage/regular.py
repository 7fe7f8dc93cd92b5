"""Reading small files that others may have put there."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from cdmisfa.core.errors import UsageError


def check_regular(path: Path, limit: int) -> None:
    """Refuse what is no regular file, or too large, by looking at it only.

    Raises:
        UsageError: so it is; or it cannot be looked at.
    """
    try:
        _check(path, os.stat(path), limit)
    except FileNotFoundError:
        raise UsageError(f"{path}: no regular file (No such file or directory)") from None
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from None


def read_regular(path: Path, limit: int) -> bytes:
    """The bytes of a regular file; never waits as for a pipe, never reads more than the limit.

    Raises:
        UsageError: it is no regular file, has more bytes, or cannot be read.
    """
    try:
        with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb") as file:
            _check(path, os.fstat(file.fileno()), limit)
            return file.read(limit)
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from None


def _check(path: Path, found: os.stat_result, limit: int) -> None:
    if not stat.S_ISREG(found.st_mode):
        raise UsageError(f"{path}: no regular file, remove it or name another")
    if found.st_size > limit:
        raise UsageError(f"{path}: {found.st_size} bytes, above the limit of {limit}")
