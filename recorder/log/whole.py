"""Files and folders that are there in whole, or not at all.

What is being written has a name of its own until it is complete, so a NAME is always whole. A log
is called NAME.partial, for it is readable; anything else NAME.<process>.partial, so that two
processes never write one file.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import shutil
import stat
from collections.abc import Iterator
from pathlib import Path

from cdmisfa.core.errors import LogWriteError, UsageError
from recorder.mcap.store import PARTIAL


def partial_path(path: Path) -> Path:
    """Where a log is written until it is complete."""
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
    """Make a folder, with those above it, that a power cut cannot take away again.

    Raises:
        UsageError: a file stands there.
    """
    for path in (folder, *folder.parents):
        refuse_file(path)
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for made in reversed(missing):
        to_disk(made.parent)


def refuse_file(folder: Path) -> None:
    """Refuse to make a folder where a file stands.

    Raises:
        UsageError: so it does.
    """
    if folder.is_file():
        raise UsageError(f"{folder} is a file: name a folder, which is made if it is not there")


def refuse_taken(path: Path, *, force: bool) -> None:
    """Refuse to write a file where something is; with `force`, where something else is than a file.

    Raises:
        UsageError: so it is.
    """
    refuse_special(path)
    if path.is_dir():
        raise UsageError(f"{path} is a folder: name the file to write")
    if path.exists() and not force:
        raise UsageError(f"{path} exists: choose another name or overwrite with --force")


def refuse_unless_png(path: Path) -> None:
    """Refuse to write a picture, which is a PNG, under the name of something else.

    Raises:
        UsageError: its name ends otherwise.
    """
    if path.suffix.lower() != ".png":
        raise UsageError(f"{path}: the picture is a PNG, name it {path.stem}.png")


def refuse_special(*paths: Path) -> None:
    """Refuse to replace what is no file or folder, as a device, a pipe or a link to one.

    Raises:
        UsageError: one is.
    """
    for path in paths:
        try:
            mode = os.stat(path).st_mode
        except OSError:
            continue
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise UsageError(f"{path} is no file but a device, pipe or socket: choose another name")


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
        A path that does not exist.

    Raises:
        UsageError: that name is a device's, or that of something else that is no file, or a file
            stands where its folder would be.
        LogWriteError: it cannot be written.
    """
    refuse_special(path)
    partial = path.with_name(f"{path.name}.{os.getpid()}{PARTIAL}")
    try:
        make_folder(partial.parent)
        for left in _left(path):
            _remove(left)
        _remove(partial)
        yield partial
        if sync and partial.is_file():
            to_disk(partial)
        if path.is_dir() or partial.is_dir():
            _remove(path)
        os.replace(partial, path)
        if sync:
            to_disk(path.parent)
    except OSError as error:
        if error.errno in (errno.ENOTEMPTY, errno.EEXIST):
            raise LogWriteError(
                f"{path} was written by another process meanwhile: choose another name"
            ) from error
        raise LogWriteError(f"{path} cannot be written: {error.strerror or error}") from error
    finally:
        with contextlib.suppress(OSError):
            _remove(partial)


def _left(path: Path) -> Iterator[Path]:
    """What processes left of a name that are not there any more."""
    name = re.compile(rf"{re.escape(path.name)}\.(\d+){re.escape(PARTIAL)}")
    for other in path.parent.iterdir():
        if (found := name.fullmatch(other.name)) and not _lives(int(found[1])):
            yield other


def _lives(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        with contextlib.suppress(FileNotFoundError):  # another process removes it, too
            shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
