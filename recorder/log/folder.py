"""A recording's folder: held by one process at a time, and the names of its files."""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import os
import re
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Final

from cdmisfa.core.errors import LogWriteError, UsageError
from recorder.log.whole import make_folder, refuse_file, refuse_special

RECORDING = "recording.json"
"""File that says how a recording was begun; gone when every view is finished.

Beside the logs, because these hold the same bytes whatever length was wanted first.
"""

_HELD: Final[set[tuple[int, int]]] = set()
"""Folders that this process holds."""

_LOG = re.compile(r"(?P<name>.+)\.mcap(\.partial(\.kept)?)?")
_PART = re.compile(r"-\d{3,}$")


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
        _HELD.add(_which(handle))
        try:
            yield
        finally:
            _HELD.discard(_which(handle))
    finally:
        os.close(handle)


def refuse_held(folder: Path) -> None:
    """Refuse to replace what is being written where another process holds the folder.

    It writes many files, and has not all of them open.

    Raises:
        UsageError: so it is.
    """
    if _which(folder) not in _HELD:
        with held(folder):
            pass


def _which(folder: Path | int) -> tuple[int, int]:
    found = os.stat(folder)
    return found.st_dev, found.st_ino


def folder_here(place: str | Path) -> Path:
    """A folder of this machine, by its path.

    Raises:
        UsageError: it is a URL, which would become a folder `s3:`.
    """
    if re.match(r"[A-Za-z][A-Za-z0-9+.-]+:/", str(place)):
        raise UsageError(f"{place} is a URL: name a path on this machine")
    return Path(place)


def part_name(view: str, number: int | None) -> str:
    """Name of a view's file, or of one of its parts."""
    return f"{view}.mcap" if number is None else f"{view}-{number:03d}.mcap"


def part_number(path: Path, view: str) -> int | None:
    """Number of a view's part by its file's name; None for the file of one that is not split."""
    number = path.name.removeprefix(view).partition(".")[0]
    return int(number[1:]) if number else None


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


def refuse_existing(folder: Path, *, force: bool, goes_on: bool = True) -> None:
    """Refuse to write a recording or a run where there is something.

    Args:
        folder: of the recording or the run.
        force: what is there is overwritten.
        goes_on: whether what is there could be gone on with instead, by --resume.

    Raises:
        UsageError: the folder is not empty and `force` is not set, or it is a file.
    """
    refuse_special(folder)
    refuse_file(folder)
    if folder.exists() and not force and any(folder.iterdir()):
        other = ", go on with --resume" if goes_on else ""
        raise UsageError(f"{folder} exists: choose another folder{other} or overwrite with --force")


def holds_recording(folder: Path) -> bool:
    """Whether a folder holds what may be of a recording, or nothing yet."""
    there = list(folder.iterdir()) if folder.is_dir() else []
    return not there or any(
        _LOG.fullmatch(path.name) or path.name.startswith(RECORDING) for path in there
    )


def logs_in(folder: Path) -> list[Path]:
    """The logs in a folder, finished or not."""
    return sorted(p for p in folder.glob("*.mcap*") if _LOG.fullmatch(p.name) and p.is_file())


@contextlib.contextmanager
def prepared_folder(
    folder: Path, views: Sequence[str], stale: Sequence[Path] = ()
) -> Iterator[None]:
    """Make and hold a recording's folder, and remove what it has of some views.

    Args:
        folder: of the recording.
        views: whose files are removed.
        stale: files of other recordings to be removed, with how they were begun.

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
            for path in sorted(old, reverse=True):  # what is left by a kill has its first parts
                path.unlink(missing_ok=True)
        except OSError as error:
            raise LogWriteError(f"{folder} cannot be used: {error.strerror}") from error
        yield
