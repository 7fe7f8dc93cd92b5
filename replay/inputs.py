"""Logs that words of a command line name: found, and opened as sources of frames."""

from __future__ import annotations

import contextlib
import glob
import shlex
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, TypeVar

from cdmisfa.core.errors import LogDamagedError, UsageError
from recorder.images.options import InputOptions
from recorder.mcap.records import no_log
from replay.arrays import ENDINGS, ArrayLog, are_arrays, open_arrays
from replay.camera_logs.opening import (
    ALL,
    channels_of,
    image_logs,
    image_topics,
    only_foreign,
)
from replay.camera_logs.pictures import by_number
from replay.camera_logs.source import ForeignSource, UnequalError
from replay.recordings.source import RecordedSource, SeveralRecordingsError
from replay.recordings.view_file import NoRecordingError
from replay.runs.folders import RUN_FILE, is_run
from replay.storage.location import is_url, location
from replay.storage.opening import no_such, starts_as_log

Logged = RecordedSource | ForeignSource | ArrayLog
"""Frames from logs, or from files of arrays."""

About = Callable[[Logged], None]
"""Given logs that were opened to be looked at, to say what they are."""


def open_log(
    paths: Sequence[Path],
    inputs: InputOptions | None = None,
    *,
    loop: bool = False,
    salvage: bool = False,
    goal: tuple[str, str] = ("learn", "RUN"),
) -> Logged:
    """Open one of our recordings, camera logs of others, or files of NumPy's arrays.

    Args:
        paths: the folder of a recording or its views' files, or logs of others.
        inputs: how images of others become frames; given, the paths are taken as such logs.
        loop: start again at the end.
        salvage: pass over what is damaged.
        goal: the command and the folder of its result that a refusal names in what would work.

    Raises:
        UsageError: no such log, a run, or as for `ForeignSource`.
        LogDamagedError: a log is damaged.
    """
    inputs = inputs or InputOptions()
    for path in paths:
        refuse_what_is_no_log(path)
    if are_arrays(paths):
        return open_arrays(paths, inputs, loop=loop)
    left_out: list[str] = []
    if salvage:
        paths, inputs, left_out = _readable(paths, inputs)
    if not inputs.external and not any(map(only_foreign, paths)):
        with contextlib.suppress(NoRecordingError):
            return _without(left_out, RecordedSource(paths, loop=loop, salvage=salvage))
    return _without(left_out, _open(paths, inputs, loop=loop, salvage=salvage, goal=goal))


def open_to_look(
    paths: Sequence[Path], inputs: InputOptions | None = None, *, salvage: bool = False
) -> Logged:
    """Open logs to view, export or play: every topic of images, aligned by time if need be.

    Of files of arrays all are shown.

    What `cameras` choose is opened as they say. Of up to `AT_ONCE` bytes all are checked, of more
    what is read.

    Raises:
        UsageError: as for `open_log`.
        LogDamagedError: a log is damaged.
    """
    for path in paths:
        refuse_what_is_no_log(path)
    inputs = inputs or InputOptions()
    chosen = bool(inputs.topics or inputs.fields)
    if not (chosen or are_arrays(paths) or any(map(only_foreign, paths))):
        with contextlib.suppress(NoRecordingError, SeveralRecordingsError):
            return _checked(RecordedSource(paths, salvage=salvage))
    goal = ("convert", "REC")
    if not chosen:
        inputs = replace(inputs, topics=ALL)
    try:
        return _checked(open_cameras(paths, inputs, salvage=salvage, goal=goal))
    except UnequalError:
        inputs = replace(inputs, align="time")
        return _checked(open_cameras(paths, inputs, salvage=salvage, goal=goal))


def _checked(source: Logged) -> Logged:
    """Logs, with the checksum over all their data checked where that takes no time."""
    try:
        source.describe_at_once()
    except BaseException:
        source.close()
        raise
    return source


def open_cameras(
    paths: Sequence[str | Path],
    inputs: InputOptions,
    *,
    loop: bool = False,
    salvage: bool = False,
    goal: tuple[str, str] = ("learn", "RUN"),
) -> ForeignSource | ArrayLog:
    """Open the camera logs of others, or files of arrays, as streams on one clock.

    See `ForeignSource` and `open_arrays`. With `salvage` a log of several that cannot be read is
    left out: `left_out` of the source says so, as its warnings do.
    """
    places = list(map(location, paths))
    if are_arrays(places):
        return open_arrays(places, inputs, loop=loop)
    left_out: list[str] = []
    if salvage:
        paths, inputs, left_out = _readable(image_logs(paths), inputs)
    return _without(left_out, _open(paths, inputs, loop=loop, salvage=salvage, goal=goal))


def _open(paths: Sequence[str | Path], inputs: InputOptions, **how: Any) -> ForeignSource:
    chosen: dict[str, Any] = {each.name: getattr(inputs, each.name) for each in fields(inputs)}
    return ForeignSource(paths, **chosen, **how)


def _readable(
    paths: Sequence[Path], inputs: InputOptions
) -> tuple[list[Path], InputOptions, list[str]]:
    """The logs of several that can be read, with their topics, and why the others cannot.

    Raises:
        LogDamagedError: none can be read.
    """
    broken: dict[Path, LogDamagedError] = {}
    for path in paths if len(paths) > 1 else ():
        try:
            if only_foreign(path):
                channels_of(path)
            elif path.is_file():
                image_topics(path)
        except LogDamagedError as error:
            broken[path] = error
    if len(broken) == len(paths):
        raise broken[paths[0]]
    if len(inputs.topics) == len(paths):  # one of each
        pairs = zip(paths, inputs.topics, strict=True)
        inputs = replace(inputs, topics=tuple(t for path, t in pairs if path not in broken))
    said = [f"{error}: this log is left out" for error in broken.values()]
    return [path for path in paths if path not in broken], inputs, said


Opened = TypeVar("Opened", RecordedSource, ForeignSource)


def _without(left_out: Sequence[str], source: Opened) -> Opened:
    """A source that says which logs were left out of it."""
    source.left_out = tuple(left_out)
    source.warnings = (*left_out, *source.warnings)
    return source


def holds_run(path: Path) -> bool:
    """Whether a folder or a file is a run, and no camera log.

    Raises:
        UsageError: it does not exist.
        LogDamagedError: it is no log, or a damaged one.
    """
    return not only_foreign(path) and not are_arrays([path]) and is_run(path)


def is_recording(words: Sequence[str]) -> bool:
    """Whether what words name is one of our recordings.

    Raises:
        UsageError: there is no such log.
        LogDamagedError: a log is damaged.
    """
    places = locations(words)
    if are_arrays(places) or any(map(only_foreign, places)):
        return False
    try:
        RecordedSource(places).close()
    except NoRecordingError:
        return False
    return True


def refuse_what_is_no_log(path: Path) -> None:
    """Refuse a run, or a file that is no log.

    Raises:
        UsageError: it is one of them.
    """
    if path.is_dir():
        run = is_run(path)
    elif not path.exists():
        raise no_such(path)
    elif starts_as_log(path):
        run = path.name.startswith(RUN_FILE) and is_run(path)
    elif only_foreign(path) or ".mcap" in path.suffixes or path.suffix.lower() in ENDINGS:
        run = False
    else:
        raise no_log(path)
    if run:
        raise _a_run(path)


def _a_run(path: Path) -> UsageError:
    return UsageError(
        f"{path} is a run, not a recording: look at it with cdmisfa view {shlex.quote(str(path))}, "
        "or learn from what it learned from"
    )


def locations(words: Sequence[str | Path]) -> list[Path]:
    """Return the paths that words name, in their order; a pattern names matches, by number.

    Raises:
        UsageError: nothing matches a pattern, or a URL is of a kind that is not read.
        CdmisfaError: a server does not give what a URL names.
    """
    found: list[Path] = []
    for word in words:
        pattern = isinstance(word, str) and not is_url(word) and any(c in word for c in "*?[")
        if pattern and not Path(word).exists():
            found += _matches(str(word))
        else:
            found.append(location(word))
    return found


def _matches(word: str) -> list[Path]:
    matched = [Path(name) for name in glob.glob(word, recursive=True)]
    matched = [path for path in matched if path.suffix not in (".rrd", ".json")]
    if not matched:
        raise UsageError(f"{word}: no file or folder matches")
    return sorted(matched, key=by_number)
