"""Write files that exist as a whole or not at all, and find the files of a recording.

A file that is being written has another name until it is complete, so a NAME is always whole. A log
is called NAME.partial, for it is readable; anything else NAME.<process>.partial, so that two
processes never write one file. One process at a time holds a folder.
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

# File that says how a recording was started; gone when every view is finished.
#
# It is beside the logs, because these hold the same bytes whatever length was wanted first.
RECORDING: Final = "recording.json"

# Endings of names that are always taken for files, never for folders.
_OF_FILES = frozenset({".csv", ".json", ".mcap", ".mp4", ".npz", ".parquet", ".png", ".rrd"})
_LOG = re.compile(r"(?P<name>.+)\.mcap(\.partial(\.kept)?)?")
_PART = re.compile(r"-\d{3,}$")


# Checks of the name of an output; each raises a UsageError


def refuse_special(*paths: Path) -> None:
    """Refuse to replace a device, a pipe, a socket, or a link to one."""
    for path in paths:
        if os.path.exists(path) and not (os.path.isfile(path) or os.path.isdir(path)):
            raise UsageError(f"{path} is no file but a device, pipe or socket: choose another name")


def refuse_file(folder: Path) -> None:
    """Refuse to make a folder where a file, a device or a pipe is."""
    refuse_special(folder)
    if folder.is_file():
        raise UsageError(f"{folder} is a file: name a folder, which is made if it is not there")


def refuse_taken(path: Path, *, force: bool) -> None:
    """Refuse to write a file where something is; with `force`, where that is no file."""
    refuse_special(path)
    if path.is_dir() or (path.exists() and not force):
        what = "is a folder" if path.is_dir() else "exists"
        raise UsageError(f"{path} {what}: choose another name, or overwrite a file with --force")


def refuse_unless(path: Path, what: str, *endings: str) -> None:
    """Refuse to write a file under the name of another kind.

    Args:
        path: the file.
        what: a clause about the file, as "the image is a PNG".
        endings: allowed endings; the first is recommended.
    """
    if path.suffix.lower() not in endings:
        raise UsageError(f"{path}: {what}, name it {path.stem}{endings[0]}")


def refuse_named_as_file(folder: Path) -> None:
    """Refuse to make a folder under the name of a file."""
    if (ending := folder.suffix.lower()) in _OF_FILES:
        raise UsageError(f"{folder}: a folder is written, name it without {ending}")


def refuse_existing(folder: Path, *, force: bool, goes_on: bool = True) -> None:
    """Refuse to write a recording or a run where there is something, unless with `force`.

    Args:
        folder: of the recording or the run.
        force: overwrite its content.
        goes_on: whether --resume could continue its content.
    """
    refuse_file(folder)
    refuse_named_as_file(folder)
    if folder.exists() and not force and any(folder.iterdir()):
        other = ", continue with --resume" if goes_on else ""
        raise UsageError(f"{folder} exists: choose another folder{other} or overwrite with --force")


def folder_here(place: str | Path) -> Path:
    """Return a folder of this machine by its path; refuse a URL, which would become a folder."""
    if re.match(r"[A-Za-z][A-Za-z0-9+.-]+:/", str(place)):
        raise UsageError(f"{place} is a URL: name a path on this machine")
    return Path(place)


# Paths within a document


def relative_path(word: str, folder: Path) -> str:
    """Return a path relative to a folder, so that both can move; a URL as it is."""
    return word if "://" in word else os.path.join(os.curdir, os.path.relpath(word, folder))


def found_path(word: str, folder: Path) -> str:
    """Resolve a path of `relative_path`; return another word as it is."""
    return os.path.normpath(folder / word) if word.startswith(os.curdir) else word


# Files that replace others as a whole


@contextlib.contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a path to write a file or a folder at, which takes its own name once it is complete.

    Its folder is made; a file or folder of that name is replaced. After an error nothing is left.
    The disk has all of a file before it takes its name, and then the name, so that a power cut
    leaves this file or the one before.

    Raises:
        UsageError: a device or a pipe has that name, or a file that of its folder.
        LogWriteError: it cannot be written.
    """
    refuse_special(path)
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
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
    except OSError as error:
        raise LogWriteError(f"{path} cannot be written: {error.strerror or error}") from error
    finally:
        with contextlib.suppress(OSError):
            _remove(partial)


def _remove_leftovers(path: Path) -> None:
    """Remove what processes that were killed have left of a file."""
    name = re.compile(rf"{re.escape(path.name)}\.(\d+)\.partial")
    for other in path.parent.iterdir():
        if match := name.fullmatch(other.name):
            try:
                os.kill(int(match[1]), 0)  # signal 0 only asks whether the process lives
            except (ProcessLookupError, OverflowError):
                _remove(other)
            except PermissionError:
                pass  # it lives, and is another user's


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        with contextlib.suppress(FileNotFoundError):  # another process removes it, too
            shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def to_disk(path: Path) -> None:
    """Sync a file, or the names in a folder, before anything else is done."""
    try:
        handle = os.open(path, os.O_RDONLY)
    except PermissionError:
        return  # a folder that may be written, but not read
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno != errno.EINVAL:  # some file systems cannot sync folders
            raise
    finally:
        os.close(handle)


def make_folder(folder: Path) -> None:
    """Make a folder, with its parents, that a power cut cannot take away again.

    Raises:
        UsageError: there is a file of that name.
    """
    paths = (folder, *folder.parents)
    for path in paths:
        refuse_file(path)
    missing = [path for path in paths if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for made in reversed(missing):
        to_disk(made.parent)


@contextlib.contextmanager
def held(folder: Path) -> Iterator[None]:
    """Keep every other process that holds folders out of this one; a kill releases it, too.

    Raises:
        UsageError: another process holds it, or there is no such folder.
    """
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(handle)
        raise UsageError(
            f"{folder} is in use by another process: wait for it, or choose another folder"
        ) from error
    except OSError:
        pass  # a file system without locks: nothing can be held there
    try:
        yield
    finally:
        os.close(handle)


# The files of a recording


def partial_path(path: Path) -> Path:
    """Return the name of a log until it is complete."""
    return path.with_name(path.name + ".partial")


def aside_path(path: Path) -> Path:
    """Return the name of a partial log while its frames are copied into a new one."""
    return path.with_name(path.name + ".partial.kept")


def part_name(view: str, number: int | None) -> str:
    """Return the name of a view's file, or of one of its parts."""
    return f"{view}.mcap" if number is None else f"{view}-{number:03d}.mcap"


def part_number(path: Path, view: str) -> int | None:
    """Return the number of a view's part by its file's name; None if the view is not split."""
    number = path.name.removeprefix(view).partition(".")[0]
    return int(number[1:]) if number else None


def logs_in(folder: Path) -> list[Path]:
    """List the logs in a folder, finished or not."""
    return sorted(p for p in folder.glob("*.mcap*") if _LOG.fullmatch(p.name) and p.is_file())


def view_logs(folder: Path, views: Collection[str]) -> dict[str, list[Path]]:
    """List the files of some views in a folder, finished or not.

    Raises:
        UsageError: one is no file but a device or a pipe.
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
    """Return whether a folder may hold a recording, or holds nothing yet."""
    paths = list(folder.iterdir()) if folder.is_dir() else []
    return not paths or any(
        _LOG.fullmatch(path.name) or path.name.startswith(RECORDING) for path in paths
    )


@contextlib.contextmanager
def prepared_folder(
    folder: Path, views: Sequence[str], stale: Sequence[Path] = ()
) -> Iterator[None]:
    """Make and hold a recording's folder, and remove its files of some views.

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
