"""Opening what holds frames: a recording of ours, or camera logs of others."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from cdmisfa.core.errors import UsageError
from recorder.mcap.reader import LogReader
from replay.camera_logs.catalogue import ALL
from replay.camera_logs.opening import only_foreign
from replay.camera_logs.options import CameraOptions
from replay.camera_logs.source import ForeignSource, UnequalError
from replay.recordings.source import RecordedSource, SeveralRecordingsError
from replay.recordings.view_file import NoRecordingError
from replay.runs.folders import RUN_FILE, RUN_METADATA, is_run
from replay.storage.location import Location, Url
from replay.storage.opening import open_store, starts_as_log

Logged = RecordedSource | ForeignSource
"""Frames from logs."""


def open_log(
    paths: Sequence[Location],
    cameras: CameraOptions | None = None,
    *,
    loop: bool = False,
    salvage: bool = False,
    goal: tuple[str, str] = ("learn", "RUN"),
) -> Logged:
    """Open a recording of ours, or what else holds images.

    Args:
        paths: the folder of a recording or its views' files, or camera logs of others.
        cameras: how images of others become frames; given, the paths are taken as such logs.
        loop: start again at the end.
        salvage: pass over what is damaged.
        goal: the command and the folder of its result that a refusal names in what would work.

    Raises:
        UsageError: no such log, a run, or as for `ForeignSource`.
        LogDamagedError: a log is damaged.
    """
    cameras = cameras or CameraOptions()
    for path in paths:
        refuse_what_is_no_log(path)
    if cameras == CameraOptions() and not any(map(only_foreign, paths)):
        with contextlib.suppress(NoRecordingError):
            return RecordedSource(paths, loop=loop, salvage=salvage)
        for path in paths:
            _refuse_remote_run(path)
    return open_cameras(paths, cameras, loop=loop, salvage=salvage, goal=goal)


def open_to_look(
    paths: Sequence[Location], cameras: CameraOptions | None = None, *, salvage: bool = False
) -> Logged:
    """Open what `open_log` does, with every topic of images; those that differ by their times.

    What `cameras` choose is opened as they say.

    Raises:
        UsageError: as for `open_log`.
        LogDamagedError: a log is damaged.
    """
    for path in paths:
        refuse_what_is_no_log(path)
    cameras = cameras or CameraOptions()
    chosen = bool(cameras.topics or cameras.fields)
    if not chosen and not any(map(only_foreign, paths)):
        with contextlib.suppress(NoRecordingError, SeveralRecordingsError):
            return RecordedSource(paths, salvage=salvage)
    goal = ("convert", "REC")
    if not chosen:
        cameras = replace(cameras, topics=ALL)
    try:
        return open_cameras(paths, cameras, salvage=salvage, goal=goal)
    except UnequalError:
        return open_cameras(paths, replace(cameras, align="time"), salvage=salvage, goal=goal)


def open_cameras(
    paths: Sequence[str | Location],
    cameras: CameraOptions,
    *,
    loop: bool = False,
    salvage: bool = False,
    goal: tuple[str, str] = ("learn", "RUN"),
) -> ForeignSource:
    """Open the camera logs of others as streams on one clock; see `ForeignSource`."""
    chosen: dict[str, Any] = {each.name: getattr(cameras, each.name) for each in fields(cameras)}
    return ForeignSource(paths, **chosen, loop=loop, salvage=salvage, goal=goal)


def holds_run(path: Path) -> bool:
    """Whether a folder or a file is a run, and no camera log.

    Raises:
        UsageError: it does not exist.
        LogDamagedError: it is no log, or a damaged one.
    """
    return not only_foreign(path) and is_run(path)


def refuse_what_is_no_log(path: Location) -> None:
    """Refuse a run, and a file of another kind, neither of which is a damaged recording.

    Raises:
        UsageError: it is one of them.
    """
    if isinstance(path, Url):  # opened only once: see `_refuse_remote_run`
        return
    if path.is_dir():
        run = is_run(path)
    elif not path.exists():
        raise UsageError(f"{path}: no such file or folder")
    elif starts_as_log(path):
        run = path.name.startswith(RUN_FILE) and is_run(path)
    elif only_foreign(path) or ".mcap" in path.suffixes:  # the latter is a damaged log
        run = False
    else:
        raise UsageError(f"{path} is no MCAP file: name a recording, or logs of cameras")
    if run:
        raise _a_run(path)


def _refuse_remote_run(path: Location) -> None:
    """Refuse a run behind a URL, once it is known to be no recording."""
    if isinstance(path, Url) and not path.folder:
        with LogReader(open_store(path)) as reader:
            if any(record.name == RUN_METADATA for record in reader.metadata):
                raise _a_run(path)


def _a_run(path: Location) -> UsageError:
    return UsageError(
        f"{path} is a run, not a recording: look at it with cdmisfa view {shlex.quote(str(path))}, "
        "or learn from what it learned from"
    )
