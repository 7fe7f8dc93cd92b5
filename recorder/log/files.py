"""Files that are there in whole or not at all, and a recording's folder with its files.

What is being written has a name of its own until it is complete, so a NAME is always whole. A log
is called NAME.partial, for it is readable; anything else NAME.<process>.partial, so that two
processes never write one file. A folder is held by one process at a time.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import itertools
import os
import re
import shutil
import stat
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Final

from cdmisfa.core.errors import LogWriteError, UsageError

PARTIAL = ".partial"
"""Ending of what is being written, or whose writing was cut short."""

RECORDING = "recording.json"
"""File that says how a recording was started; gone when every view is finished.

Beside the logs, because these hold the same bytes whatever length was wanted first.
"""

OF_FILES: Final = frozenset({".csv", ".json", ".mcap", ".mp4", ".npz", ".parquet", ".png", ".rrd"})
"""Endings of what is a file wherever it is written."""

_HELD: Final[set[tuple[int, int]]] = set()
"""Folders that this process holds."""

_LOG = re.compile(r"(?P<name>.+)\.mcap(\.partial(\.kept)?)?")
_PART = re.compile(r"-\d{3,}$")


def partial_path(path: Path) -> Path:
    """Where a log is written until it is complete."""
    return path.with_name(path.name + PARTIAL)


def aside_path(path: Path) -> Path:
    """Where a partial log is kept while its frames are copied into a new one."""
    return path.with_name(path.name + ".partial.kept")


def to_disk(path: Path) -> None:
    """Sync a file, or the names in a folder, before anything else is done."""
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
        UsageError: something stands there that is no folder.
    """
    above = (folder, *folder.parents)
    for path in above:
        refuse_file(path)
    missing = [path for path in above if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for made in reversed(missing):
        to_disk(made.parent)


# What is refused, with a UsageError


def refuse_file(folder: Path) -> None:
    """Refuse to make a folder where a file stands, or a device or a pipe."""
    refuse_special(folder)
    if folder.is_file():
        raise UsageError(f"{folder} is a file: name a folder, which is made if it is not there")


def refuse_taken(path: Path, *, force: bool) -> None:
    """Refuse to write a file where something is; with `force`, where that is no file."""
    refuse_special(path)
    if path.is_dir():
        raise UsageError(f"{path} is a folder: name the file to write")
    if path.exists() and not force:
        raise UsageError(f"{path} exists: choose another name or overwrite with --force")


def refuse_unless(path: Path, what: str, *endings: str) -> None:
    """Refuse to write a file under the name of another kind.

    Args:
        path: of the file.
        what: it is, as "the picture is a PNG".
        endings: that it may have, the first is its own.
    """
    if path.suffix.lower() not in endings:
        raise UsageError(f"{path}: {what}, name it {path.stem}{endings[0]}")


def refuse_named_as_file(folder: Path) -> None:
    """Refuse to make a folder under the name of a file."""
    if (ending := folder.suffix.lower()) in OF_FILES:
        raise UsageError(f"{folder}: a folder is written, name it without {ending}")


def refuse_special(*paths: Path) -> None:
    """Refuse to replace what is no file or folder, as a device, a pipe or a link to one."""
    for path in paths:
        try:
            mode = os.stat(path).st_mode
        except OSError:
            continue
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise UsageError(f"{path} is no file but a device, pipe or socket: choose another name")


def refuse_existing(folder: Path, *, force: bool, goes_on: bool = True) -> None:
    """Refuse to write a recording or a run where there is something, unless with `force`.

    Args:
        folder: of the recording or the run.
        force: what is there is overwritten.
        goes_on: whether what is there could be resumed instead, by --resume.
    """
    refuse_file(folder)
    refuse_named_as_file(folder)
    if folder.exists() and not force and any(folder.iterdir()):
        other = ", go on with --resume" if goes_on else ""
        raise UsageError(f"{folder} exists: choose another folder{other} or overwrite with --force")


def folder_here(place: str | Path) -> Path:
    """A folder of this machine, by its path; a URL, which would become a folder, is refused."""
    if re.match(r"[A-Za-z][A-Za-z0-9+.-]+:/", str(place)):
        raise UsageError(f"{place} is a URL: name a path on this machine")
    return Path(place)


def relative_path(word: str, folder: Path) -> str:
    """A path relative to the folder that keeps it, so that both can move; a URL as it is."""
    return word if "://" in word else os.path.join(os.curdir, os.path.relpath(word, folder))


def found_path(word: str, folder: Path) -> str:
    """A path of `relative_path` where it lies now; another word as it is."""
    return os.path.normpath(folder / word) if word.startswith(os.curdir) else word


# Files that replace what was there


@contextlib.contextmanager
def atomic_write(path: Path, *, sync: bool = True) -> Iterator[Path]:
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
        for left in (*_left_behind(path), partial):
            _remove(left)
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


def _left_behind(path: Path) -> list[Path]:
    """What processes left of a name that are not there any more."""
    name = re.compile(rf"{re.escape(path.name)}\.(\d+){re.escape(PARTIAL)}")
    found = ((other, name.fullmatch(other.name)) for other in path.parent.iterdir())
    return [other for other, match in found if match and not _lives(int(match[1]))]


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


# A folder that one process holds


@contextlib.contextmanager
def held(folder: Path) -> Iterator[None]:
    """Keep every other process that holds folders out of this one; a kill lets go of it, too.

    Raises:
        UsageError: another process holds it, or there is no such folder.
    """
    try:
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise UsageError(f"{folder} is no folder that can be opened: {error.strerror}") from error
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise UsageError(
                f"{folder} is in use by another process: wait for it, or choose another folder"
            ) from error
        except OSError:
            pass  # A file system without locks: nothing can be held there.
        _HELD.add(_inode(handle))
        try:
            yield
        finally:
            _HELD.discard(_inode(handle))
    finally:
        os.close(handle)


def refuse_held(folder: Path) -> None:
    """Refuse to replace what is being written where another process holds the folder.

    It writes many files, and has not all of them open.

    Raises:
        UsageError: so it is.
    """
    if _inode(folder) not in _HELD:
        with held(folder):
            pass


def _inode(folder: Path | int) -> tuple[int, int]:
    found = os.stat(folder)
    return found.st_dev, found.st_ino


# The files of a recording


def part_name(view: str, number: int | None) -> str:
    """Name of a view's file, or of one of its parts."""
    return f"{view}.mcap" if number is None else f"{view}-{number:03d}.mcap"


def part_number(path: Path, view: str) -> int | None:
    """Number of a view's part by its file's name; None for the file of one that is not split."""
    number = path.name.removeprefix(view).partition(".")[0]
    return int(number[1:]) if number else None


def logs_in(folder: Path) -> list[Path]:
    """The logs in a folder, finished or not."""
    return sorted(p for p in folder.glob("*.mcap*") if _LOG.fullmatch(p.name) and p.is_file())


def view_logs(folder: Path, views: Collection[str]) -> dict[str, list[Path]]:
    """Files of some views in a folder, finished or not; a name may be of a part of another view.

    Raises:
        UsageError: one is no file but a device or a pipe.
    """
    found: dict[str, list[Path]] = {view: [] for view in views}
    for path in sorted(folder.iterdir()):
        if log := _LOG.fullmatch(path.name):
            for view in {log["name"], _PART.sub("", log["name"])} & found.keys():
                refuse_special(path)
                found[view].append(path)
    return found


def holds_recording(folder: Path) -> bool:
    """Whether a folder holds what may be of a recording, or nothing yet."""
    there = list(folder.iterdir()) if folder.is_dir() else []
    return not there or any(
        _LOG.fullmatch(path.name) or path.name.startswith(RECORDING) for path in there
    )


@contextlib.contextmanager
def prepared_folder(
    folder: Path, views: Sequence[str], stale: Sequence[Path] = ()
) -> Iterator[None]:
    """Make and hold a recording's folder, and remove what it has of some views.

    Args:
        folder: of the recording.
        views: whose files are removed.
        stale: files of other recordings to be removed, with how they were started.

    Raises:
        UsageError: another process holds it, or one of these is no file.
        LogWriteError: it cannot be made, or they cannot be removed.
    """
    with contextlib.ExitStack() as stack:
        try:
            make_folder(folder)
            stack.enter_context(held(folder))
            old = {*stale, *itertools.chain(*view_logs(folder, views).values())}
            old |= {folder / RECORDING} if stale else set()
            for path in sorted(old, reverse=True):  # last parts first: a kill leaves the first ones
                path.unlink(missing_ok=True)
        except OSError as error:
            raise LogWriteError(f"{folder} cannot be used: {error.strerror}") from error
        yield
