"""Files that are written completely or not at all, checks of output names, and files of recordings.

A file has another name while it is being written, so that a file with its final name is complete.
A partial log is called NAME.partial, because it can be read; other files NAME.<process>.partial, so
that two processes never write the same file. Only one process can lock a folder.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import itertools
import os
import re
import shutil
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Final

from cdmisfa.core.errors import LogWriteError, UsageError

# File with the arguments of a recording; it is deleted when every view is finished.
#
# It is not part of the logs, because their bytes must not depend on the requested length.
RECORDING: Final = "recording.json"

# File name endings that are never used for folders.
_FILE_ENDINGS = frozenset({".csv", ".json", ".mcap", ".mp4", ".npz", ".parquet", ".png", ".rrd"})
_LOG = re.compile(r"(?P<name>.+)\.mcap(\.partial(\.kept)?)?")
_PART = re.compile(r"-\d{3,}$")
_TEMPORARY = re.compile(r".+\.\d+\.partial")


# Checks of output names; each raises a UsageError


def refuse_special(*paths: Path) -> None:
    """Check that no path is a device, a pipe, a socket, or a link to one."""
    for path in paths:
        if os.path.exists(path) and not (os.path.isfile(path) or os.path.isdir(path)):
            raise UsageError(f"{path} is a device, pipe or socket: choose another name")


def refuse_file(folder: Path) -> None:
    """Check that a folder can be created at a path."""
    refuse_special(folder)
    if folder.is_file():
        raise UsageError(f"{folder} is a file: name a folder")


def refuse_taken(path: Path, *, force: bool) -> None:
    """Check that a file can be written: nothing is there or, with `force`, a file."""
    refuse_special(path)
    if path.is_dir() or (path.exists() and not force):
        problem = "is a folder:" if path.is_dir() else "exists: overwrite it with --force, or"
        raise UsageError(f"{path} {problem} choose another name")


def refuse_unless(path: Path, fact: str, *endings: str) -> None:
    """Check the ending of a file name.

    Args:
        path: the file.
        fact: a clause about the file for the error, such as "the image is a PNG".
        endings: the allowed endings; the first is recommended.
    """
    if path.suffix.lower() not in endings:
        raise UsageError(f"{path}: {fact}: name it {path.stem}{endings[0]}")


def refuse_named_as_file(folder: Path) -> None:
    """Check that a folder is not named like a file."""
    if (ending := folder.suffix.lower()) in _FILE_ENDINGS:
        raise UsageError(f"{folder}: the output is a folder: name it without {ending}")


def refuse_existing(folder: Path, *, force: bool, resumable: bool = True) -> None:
    """Check that a folder for a recording or a run is empty or, with `force`, is a folder.

    Args:
        folder: folder of the recording or the run.
        force: True to overwrite its contents.
        resumable: True if --resume could continue its contents.
    """
    refuse_file(folder)
    refuse_named_as_file(folder)
    if folder.exists() and not force and not all(map(_is_leftover, folder.iterdir())):
        resume = ", continue with --resume," if resumable else ""
        raise UsageError(f"{folder} exists: choose another folder{resume} or add --force")


def _is_leftover(path: Path) -> bool:
    """Return whether a killed process left a file without content, or one of `atomic_write`."""
    empty = _LOG.fullmatch(path.name) and path.is_file() and not path.stat().st_size
    return bool(empty or _TEMPORARY.fullmatch(path.name))


def local_folder(place: str | Path) -> Path:
    """Return the path of a folder on this machine; raise a UsageError for a URL."""
    if re.match(r"[A-Za-z][A-Za-z0-9+.-]+:/", str(place)):
        raise UsageError(f"{place} is a URL: name a path on this machine")
    return Path(place)


# Paths in a document


def relative_path(word: str, folder: Path) -> str:
    """Return a path relative to a folder, so that both can be moved; a URL unchanged."""
    return word if "://" in word else os.path.join(os.curdir, os.path.relpath(word, folder))


def resolved_path(word: str, folder: Path) -> str:
    """Resolve a path from `relative_path`; return another word unchanged."""
    return os.path.normpath(folder / word) if word.startswith(os.curdir) else word


# Files that replace others completely


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Convert an error of the operating system in the body to a LogWriteError about `path`."""
    try:
        yield
    except OSError as error:
        raise LogWriteError(f"{path} cannot be written: {error.strerror or error}") from error


@contextlib.contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary path to write a file or folder at; at the end it gets its final name.

    The parent folder is created; a file or folder with that name is replaced. An error leaves
    nothing behind. All of a file is on the disk before it gets its name, so that a power cut leaves
    either this file or the previous one.

    Raises:
        UsageError: a device or a pipe has that name, or a file has the name of the parent folder.
        LogWriteError: the file cannot be written.
    """
    refuse_special(path)
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        with writing(path):
            make_folder(partial.parent)
            _remove_leftovers(path)
            _remove(partial)
            yield partial
            if partial.is_file():
                to_disk(partial)
            if path.is_dir() or partial.is_dir():
                _remove(path)
            os.replace(partial, path)
            to_disk(path.parent)
    finally:
        with contextlib.suppress(OSError):
            _remove(partial)


def _remove_leftovers(path: Path) -> None:
    """Remove partial files of processes that were killed."""
    name = re.compile(rf"{re.escape(path.name)}\.(\d+)\.partial")
    for other in path.parent.iterdir():
        if match := name.fullmatch(other.name):
            try:
                os.kill(int(match[1]), 0)  # signal 0 only tests whether the process exists
            except (ProcessLookupError, OverflowError):
                _remove(other)
            except PermissionError:
                pass  # the process exists and belongs to another user


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        with contextlib.suppress(FileNotFoundError):  # another process removes it at the same time
            shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def to_disk(path: Path) -> None:
    """Sync a file, or the names in a folder, to the disk."""
    try:
        handle = os.open(path, os.O_RDONLY)
    except PermissionError:
        return  # a folder that can be written but not read
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno != errno.EINVAL:  # some file systems cannot sync folders
            raise
    finally:
        os.close(handle)


def make_folder(folder: Path) -> None:
    """Create a folder and its parents, and sync them, so that a power cut cannot remove them.

    Raises:
        UsageError: there is a file with that name.
    """
    paths = (folder, *folder.parents)
    for path in paths:
        refuse_file(path)
    missing = [path for path in paths if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for made in reversed(missing):
        to_disk(made.parent)


@contextlib.contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Lock a folder against other processes that use this function; a kill releases the lock.

    Raises:
        UsageError: another process has locked it, or the folder cannot be opened.
    """
    try:
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise UsageError(f"{folder} cannot be opened as a folder: {error.strerror}") from error
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(handle)
        raise UsageError(f"{folder} is in use by another process: wait for it") from error
    except OSError:
        pass  # this file system has no locks
    try:
        yield
    finally:
        os.close(handle)


# The files of a recording


def partial_path(path: Path) -> Path:
    """Return the name of a log while it is incomplete."""
    return path.with_name(path.name + ".partial")


def aside_path(path: Path) -> Path:
    """Return the name of a partial log while its frames are copied into a new one."""
    return path.with_name(path.name + ".partial.kept")


def part_name(view: str, number: int | None) -> str:
    """Return the file name of a view, or of one of its parts."""
    return f"{view}.mcap" if number is None else f"{view}-{number:03d}.mcap"


def part_number(path: Path, view: str) -> int | None:
    """Return the number of a view's part from its file name; None if the view is not split."""
    number = path.name.removeprefix(view).partition(".")[0]
    return int(number[1:]) if number else None


def logs_in(folder: Path) -> list[Path]:
    """Return the logs in a folder, finished or not."""
    return sorted(p for p in folder.glob("*.mcap*") if _LOG.fullmatch(p.name) and p.is_file())


def view_logs(folder: Path, views: Collection[str]) -> dict[str, list[Path]]:
    """Return the files of views in a folder, finished or not.

    Raises:
        UsageError: one of them is a device or a pipe.
    """
    logs: dict[str, list[Path]] = {view: [] for view in views}
    for path in sorted(folder.iterdir()):
        if log := _LOG.fullmatch(path.name):
            # "left-001.mcap" is a part of "left", or the file of a view "left-001".
            for view in {log["name"], _PART.sub("", log["name"])} & logs.keys():
                refuse_special(path)
                logs[view].append(path)
    return logs


def holds_recording(folder: Path) -> bool:
    """Return whether a folder has parts of a recording, or is empty."""
    names = [path.name for path in folder.iterdir()] if folder.is_dir() else []
    return not names or any(_LOG.fullmatch(n) or n.startswith(RECORDING) for n in names)


@contextlib.contextmanager
def prepared_folder(
    folder: Path, views: Sequence[str], stale: Sequence[Path] = ()
) -> Iterator[None]:
    """Create and lock a recording's folder, and remove files of earlier recordings.

    Args:
        folder: folder of the recording.
        views: views whose files are removed.
        stale: files of other recordings that are removed, together with their arguments.

    Raises:
        UsageError: another process has locked the folder, or one of the files is a device.
        LogWriteError: the folder cannot be created, or a file cannot be removed.
    """
    with contextlib.ExitStack() as stack:
        with writing(folder):
            make_folder(folder)
            stack.enter_context(locked_folder(folder))
            old = {*stale, *itertools.chain(*view_logs(folder, views).values())}
            old |= {folder / RECORDING} if stale else set()
            for path in sorted(old, reverse=True):  # last parts first: a kill leaves a beginning
                path.unlink(missing_ok=True)
        yield
