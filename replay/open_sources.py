"""Open recordings, external logs and arrays as sources of frames."""

from __future__ import annotations

import contextlib
import glob
import shlex
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from cdmisfa.core.errors import LogDamagedError, UsageError
from recorder.images.options import InputOptions
from recorder.mcap.records import no_log
from replay.logs.aligning import UnequalError, join_parts
from replay.logs.color_choice import CHOSEN, shows_hue
from replay.logs.formats import views
from replay.logs.formats.arrays import array_streams
from replay.logs.formats.recording import NoRecordingError, ViewFile
from replay.logs.formats.views import SeveralRecordingsError
from replay.logs.open_logs import ALL, image_logs, is_external_format, open_streams
from replay.logs.source import LoggedSource
from replay.runs.folders import RUN_FILE, is_run
from replay.storage.location import is_url, location
from replay.storage.paths import log_files, natural_order, no_such, starts_as_log

# Called with logs that were opened to be shown, to print what they are.
Announce = Callable[[LoggedSource], None]

Source = TypeVar("Source")


def open_log(
    paths: Sequence[Path],
    inputs: InputOptions | None = None,
    *,
    loop: bool = False,
    skip_damaged: bool = False,
) -> LoggedSource:
    """Open one of our recordings, or external logs.

    Args:
        paths: the folder of a recording or its views' files, or external logs.
        inputs: how images of external logs become frames; with it paths are taken as such.
        loop: begin again at the end.
        skip_damaged: skip damaged parts.

    Raises:
        UsageError: no such log, a run, or as for `open_external`.
        LogDamagedError: a log is damaged.
    """
    inputs = inputs or InputOptions()
    refuse_non_logs(paths)
    if not inputs.external and not any(map(is_external_format, paths)):
        with contextlib.suppress(NoRecordingError):
            return open_recording(paths, loop=loop, skip_damaged=skip_damaged)
    return open_external(paths, inputs, loop=loop, skip_damaged=skip_damaged)


def open_for_viewing(paths: Sequence[Path], inputs: InputOptions | None = None) -> LoggedSource:
    """Open logs to view or export them: every topic of images, aligned by time if need be.

    Logs of up to `AT_ONCE` bytes are checked completely, larger ones as they are read.

    Raises:
        UsageError: as for `open_log`.
        LogDamagedError: a log is damaged.
    """
    inputs = inputs or InputOptions()
    refuse_non_logs(paths)
    source = None
    if not (inputs.topics or inputs.fields or any(map(is_external_format, paths))):
        with contextlib.suppress(NoRecordingError, SeveralRecordingsError):
            source = open_recording(paths)
    if source is None:
        source = with_every_topic(lambda how: open_external(paths, how), inputs)
    try:
        source.describe_at_once()
    except BaseException:
        source.close()
        raise
    return source


def with_every_topic(opened: Callable[[InputOptions], Source], inputs: InputOptions) -> Source:
    """Open external logs with all their topics unless some are chosen, by time if rates differ."""
    if not (inputs.topics or inputs.fields):
        inputs = replace(inputs, topics=ALL)
    try:
        return opened(inputs)
    except UnequalError:
        return opened(replace(inputs, align="time"))


def open_recording(
    paths: str | Path | Sequence[str | Path], *, loop: bool = False, skip_damaged: bool = False
) -> LoggedSource:
    """Open the views of a recording.

    Args:
        paths: a recording's folder, or the files of its views, finished or `.partial`; or URLs.
        loop: begin again at the end.
        skip_damaged: skip, in every view, frames that are damaged in one of them, and of several
            files those that cannot be read.

    Raises:
        NoRecordingError: a file is no view of a recording.
        UsageError: no such recording, or several.
        LogDamagedError: a file is damaged, or the files of a folder contradict each other.
    """
    named = [paths] if isinstance(paths, str | Path) else paths
    files: list[ViewFile] = []
    broken: list[LogDamagedError] = []
    with ExitStack() as failed:
        for path in [file for place in named for file in log_files(place)]:
            if views.has_no_frames(path):
                continue
            try:
                files.append(ViewFile(path, skip_damaged=skip_damaged))
                failed.callback(files[-1].close)
            except NoRecordingError:
                raise
            except LogDamagedError as error:
                if not skip_damaged or len(named) == 1:
                    raise
                broken.append(error)
        if not files:
            nothing = NoRecordingError(f"{named[0]}: the recording has no frames yet")
            raise [*broken, nothing][0]
        streams = views.streams(files, skip_damaged=skip_damaged)
        left_out = [f"{error}: this log is skipped" for error in broken]
        return LoggedSource(streams, loop=loop, opened=failed.pop_all(), left_out=left_out)


def open_external(
    paths: str | Path | Sequence[str | Path],
    inputs: InputOptions | None = None,
    *,
    loop: bool = False,
    skip_damaged: bool = False,
) -> LoggedSource:
    """Open external logs as streams on one clock: images of cameras, or numbers.

    Args:
        paths: one log, or one log, video, table or folder of images a stream. Logs that follow one
            another in time are parts of one stream, unless they are aligned by index.
        inputs: how images become frames.
        loop: begin again at the end.
        skip_damaged: skip damaged parts and broken images, and of several logs those that cannot
            be read; `left_out` and `warnings` of the source list them.

    Raises:
        UsageError: no such log or topic, images smaller than a frame, or streams that need `align`.
        LogDamagedError: a log is damaged.
    """
    inputs = inputs or InputOptions()
    how: Any = {"loop": loop, "skip_damaged": skip_damaged}
    if inputs.color == "auto":
        return _with_color(lambda options: open_external(paths, options, **how), inputs)
    files = image_logs([paths] if isinstance(paths, str | Path) else paths)
    with ExitStack() as failed:
        streams, logs, left_out = open_streams(files, inputs, failed, skip_damaged=skip_damaged)
        if inputs.align != "index":
            streams = join_parts(streams)
        how |= {"logs": logs, "left_out": left_out, "opened": failed.pop_all()}
        return LoggedSource(streams, inputs, **how)


def open_arrays(
    arrays: Mapping[str, Any], inputs: InputOptions | None = None, *, loop: bool = False
) -> LoggedSource:
    """Open arrays of the caller as streams, the i-th rows together; see `array_streams`.

    Raises:
        UsageError: an array holds no frames, or they show frames of different shapes.
    """
    inputs = inputs or InputOptions()
    if inputs.color == "auto":
        return _with_color(lambda options: open_arrays(arrays, options, loop=loop), inputs)
    return LoggedSource(array_streams(arrays, inputs), inputs, loop=loop)


def _with_color(
    opened: Callable[[InputOptions], LoggedSource], inputs: InputOptions
) -> LoggedSource:
    """Open a source in colors if hue adds information to brightness; see `shows_hue`."""
    with opened(replace(inputs, color=True)) as colored:
        color = shows_hue(colored)
    source = opened(replace(inputs, color=color))
    source.notes = (CHOSEN[color], *source.notes)
    return source


def holds_run(path: Path) -> bool:
    """Return whether a folder or a file is a run, and no external log.

    Raises:
        UsageError: the path does not exist.
        LogDamagedError: the file is not a log, or is damaged.
    """
    return not is_external_format(path) and is_run(path)


def is_recording(words: Sequence[str]) -> bool:
    """Return whether words name one of our recordings.

    Raises:
        UsageError: the log does not exist.
        LogDamagedError: a log is damaged.
    """
    places = locations(words)
    if not any(map(is_external_format, places)):
        with contextlib.suppress(NoRecordingError):
            open_recording(places).close()
            return True
    return False


def refuse_non_logs(paths: Sequence[Path]) -> None:
    """Refuse runs, and files that are no logs, with a UsageError."""
    for path in paths:
        if not path.exists():
            raise no_such(path)
        starts = path.is_file() and starts_as_log(path)
        if not (starts or path.is_dir() or is_external_format(path) or ".mcap" in path.suffixes):
            raise no_log(path)
        if (path.is_dir() or (starts and path.name.startswith(RUN_FILE))) and is_run(path):
            raise UsageError(
                f"{path} is a run, not a recording: open it with cdmisfa view "
                f"{shlex.quote(str(path))}, or give the recording that it learned from"
            )


def locations(words: Sequence[str | Path]) -> list[Path]:
    """Return the paths that words name, in their order; a pattern names matches, by number.

    Raises:
        UsageError: nothing matches a pattern, or a URL is of a kind that is not read.
        CdmisfaError: a URL cannot be read.
    """
    paths: list[Path] = []
    for word in words:
        pattern = isinstance(word, str) and not is_url(word) and any(c in word for c in "*?[")
        if not pattern or Path(word).exists():
            paths.append(location(word))
            continue
        matched = map(Path, glob.glob(str(word), recursive=True))
        logs = sorted((p for p in matched if p.suffix not in (".rrd", ".json")), key=natural_order)
        if not logs:
            raise UsageError(f"{word}: no file or folder matches this pattern")
        paths += logs
    return paths
