"""Reading the small files that lie beside logs, which others may have put there."""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.untrusted.memory import MAX_JSON, parse_json


def check_regular(path: Path, limit: int | None = None) -> None:
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
        UsageError: it is no regular file, or has more bytes.
        LogDamagedError: the disk does not give it.
    """
    with opened_regular(path, limit) as file:
        return file.read(limit)


@contextlib.contextmanager
def opened_regular(path: Path, limit: int | None = None) -> Iterator[BinaryIO]:
    """A regular file, open to be read; raises as `read_regular` does, in the body, too."""
    try:
        with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb") as file:
            _check(path, os.fstat(file.fileno()), limit)
            yield file
    except OSError as error:
        raise LogDamagedError(f"{path} cannot be read: {error.strerror or error}") from error


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


def _check(path: Path, found: os.stat_result, limit: int | None) -> None:
    if not stat.S_ISREG(found.st_mode):
        raise UsageError(f"{path}: no regular file, remove it or name another")
    if limit is not None and found.st_size > limit:
        raise UsageError(f"{path}: {found.st_size} bytes, above the limit of {limit}")
