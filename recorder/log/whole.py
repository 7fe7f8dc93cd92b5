"""Files and folders that are there in whole, or not at all.

What is being written is called NAME.partial until it is complete, so a NAME is always whole.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from cdmisfa.core.errors import LogWriteError

PARTIAL = ".partial"
"""Ending of what is being written, or whose writing was cut short."""


def partial_path(path: Path) -> Path:
    """Where something is written until it is complete."""
    return path.with_name(path.name + PARTIAL)


@contextlib.contextmanager
def whole(path: Path, *, sync: bool = True) -> Iterator[Path]:
    """A path to write a file or a folder at, which takes its own name once it is complete.

    Its folder is made; what was there under that name is replaced. On an error what was written
    is removed.

    Args:
        path: the name.
        sync: let the disk have all of a file before it takes its name, so that a power cut
            cannot leave an empty one.

    Yields:
        NAME.partial, which does not exist.

    Raises:
        LogWriteError: it cannot be written.
    """
    partial = partial_path(path)
    try:
        _remove(partial)
        partial.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        if sync and partial.is_file():
            with open(partial, "rb") as file:
                os.fsync(file.fileno())
        if path.is_dir() or partial.is_dir():
            _remove(path)
        os.replace(partial, path)
    except OSError as error:
        raise LogWriteError(f"{path} cannot be written: {error.strerror or error}") from error
    finally:
        with contextlib.suppress(OSError):
            _remove(partial)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
