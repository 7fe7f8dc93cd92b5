"""Files and folders that are there in whole, or not at all.

What is being written is called NAME.partial until it is complete, so a NAME is always whole.
"""

from __future__ import annotations

import contextlib
import errno
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


def to_disk(path: Path) -> None:
    """Let the disk have a file, or the names in a folder, before anything else is done."""
    try:
        handle = os.open(path, os.O_RDONLY)
    except PermissionError:
        return  # a folder that may be written, but not read
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno != errno.EINVAL:  # of a file system that cannot, as for folders of some
            raise
    finally:
        os.close(handle)


def make_folder(folder: Path) -> None:
    """Make a folder, with those above it, that a power cut cannot take away again."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for made in reversed(missing):
        to_disk(made.parent)


@contextlib.contextmanager
def whole(path: Path, *, sync: bool = True) -> Iterator[Path]:
    """A path to write a file or a folder at, which takes its own name once it is complete.

    Its folder is made; what was there under that name is replaced. On an error what was written
    is removed.

    Args:
        path: the name.
        sync: let the disk have all of a file before it takes its name, and then the name, so that
            a power cut leaves this file or the one before.

    Yields:
        NAME.partial, which does not exist.

    Raises:
        LogWriteError: it cannot be written.
    """
    partial = partial_path(path)
    try:
        _remove(partial)
        make_folder(partial.parent)
        yield partial
        if sync and partial.is_file():
            to_disk(partial)
        if path.is_dir() or partial.is_dir():
            _remove(path)
        os.replace(partial, path)
        if sync:
            to_disk(path.parent)
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
