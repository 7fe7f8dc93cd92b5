"""Resume a recording: find what an earlier attempt left of each view, and where to continue.

The logs of an attempt are read in the order of the file, up to where they are damaged or torn. A
log that is resumed is kept aside while its frames are copied into a new one, which so has the
bytes of a log that was never interrupted.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from cdmisfa.core.errors import LogWriteError, UsageError
from cdmisfa.core.untrusted import opened_regular
from recorder.log.files import (
    RECORDING,
    aside_path,
    logs_in,
    part_name,
    part_number,
    partial_path,
    view_logs,
)
from recorder.log.manifest import RecordingSpec, ViewMetadata, read_start
from recorder.log.messages import RECORDING_METADATA, view_topic
from recorder.mcap.reader import LogReader
from recorder.mcap.records import MAGIC


class FramesHeld(NamedTuple):
    """The frames in an earlier log of a view.

    Attributes:
        first: its first frame.
        stop: its frames [first, stop) are all there, except those of gaps.
        end: one more than its last frame; 0 without any.
        gaps: whether the source may lack frames, the first of a log, too.
        frames: number of frames in [first, stop).
    """

    first: int
    stop: int
    end: int
    gaps: bool = False
    frames: int = 0

    def stop_from(self, first: int) -> int:
        """Return the stop of the frames [first, stop) that are all there."""
        follows = self.first == first or (self.gaps and self.first > first)
        return self.stop if self.end and follows else first


def frames_held(path: Path, view: str, *, gaps: bool = False) -> FramesHeld:
    """Read once through a log, damaged or not, for the frames of a view that it holds.

    With `gaps` the source may lack frames.
    """
    first = stop = end = count = 0
    for topic, frame, _, _ in messages(path):
        if topic == view_topic(view):
            first, stop = (first, stop) if end else (frame, frame)
            if frame == stop or (gaps and frame > stop):
                stop, count = frame + 1, count + 1
            end = max(end, frame + 1)
    return FramesHeld(first, stop, end, gaps, count)


def messages(path: Path) -> Iterator[tuple[str, int, int, bytes]]:
    """Yield messages in the order of the file, up to where it is damaged or torn.

    Yields:
        The topic of each, its sequence number, log time in nanoseconds, and data.

    Raises:
        LogDamagedError: the disk does not give the file, which says nothing of the log.
    """
    log = _opened(path)
    if log is None:
        return
    with log:
        for segment in log.segments:
            # A gap in the frames would shift all that follow: nothing behind damage is taken.
            damage = log.first_damage
            unproven = segment.cut or (damage is not None and segment.offset >= damage)
            table = None if unproven else log.table(segment)
            if table is None:
                return
            for number, sequence, log_time, _, data in table.rows():
                channel = log.channels.get(number)
                yield channel.topic if channel else "", sequence, log_time, data


@dataclass(frozen=True, slots=True)
class ViewResume:
    """Frame and file at which a view is begun or resumed.

    Attributes:
        path: file of the part to write.
        parts: file and number of frames of each part that is finished.
        first: first frame of the part to write.
        log: the earlier log that holds the most frames of that part, if any does.
        stop: it holds [first, stop).
        stale: logs that are not needed.
        complete: whether the parts are the whole view, and nothing is to be written.
    """

    path: Path
    parts: tuple[tuple[Path, int], ...] = ()
    first: int = 0
    log: Path | None = None
    stop: int = 0
    stale: tuple[Path, ...] = ()
    complete: bool = False


def begin_view(folder: Path, view: str, split: float | None, first: int = 0) -> ViewResume:
    """Return where a view without files begins."""
    return ViewResume(folder / part_name(view, None if split is None else 0), first=first)


def resume_views(
    folder: Path,
    recording: RecordingSpec,
    views: Sequence[str],
    split: float | None,
    frames: int | None,
    default: int,
) -> tuple[dict[str, ViewResume], float | None, int]:
    """Find where each view of a recording is resumed. Changes nothing.

    Args:
        folder: of the recording.
        recording: what is recorded.
        views: names of the views.
        split: seconds of a part; None for those of the start.
        frames: frames of each view; None for those of the start.
        default: frames of each view if the recording does not say how it was started.

    Returns:
        The place of each view, the seconds of a part, and the frames of each view.

    Raises:
        UsageError: it was started with another source, seed or split, has more frames, or there
            are files of another recording.
    """
    start = read_start(folder)
    limit = min((start.split[view] for view in views if view in start.split), default=None)
    split = limit if split is None else split
    if limit not in (None, split):
        raise UsageError(
            f"{folder} was begun with --split {limit:g}s, not --split {split:g}s: go on with the "
            "same, or overwrite with --force"
        )
    earlier = {
        view: {path: frames_held(path, view, gaps=recording.gaps) for path in logs}
        for view, logs in view_logs(folder, views).items()
    }
    lengths = [start.frames[view] for view in views if view in start.frames]
    finished = all(
        files and all(path.suffix == ".mcap" for path in files) for files in earlier.values()
    )
    if not finished and not lengths:
        lengths = [default]
    for path, held in itertools.chain(*(files.items() for files in earlier.values())):
        if frames is not None and held.end > frames:
            raise UsageError(
                f"{path} holds {held.end} frames, more than --frames {frames}: --resume shortens "
                f"nothing, give --frames {held.end} or more, or overwrite with --force"
            )
        lengths.append(held.end)
    frames = frames or max(lengths)
    places = {}
    others: list[Path] = []
    for view, files in earlier.items():
        others += [p for p in files if (part_number(p, view) is None) != (split is None)]
        if not others:
            ended = recording.gaps and view not in start.frames
            places[view] = _resume_view(folder, view, recording, split, files, frames, ended=ended)
    if others := others or other_recordings(folder, recording):
        raise UsageError(
            f"{others[0]} is of another recording, or was recorded with another --split: use the "
            "same, or overwrite with --force"
        )
    return places, split, frames


def _resume_view(
    folder: Path,
    view: str,
    recording: RecordingSpec,
    split: float | None,
    files: Mapping[Path, FramesHeld],
    frames: int,
    *,
    ended: bool,
) -> ViewResume:
    """Skip the parts of a view that are finished, and find where to resume.

    Args:
        folder: of the recording.
        view: name of the view.
        recording: what is recorded.
        split: seconds of a part.
        files: all of the view's files, and the frames in each.
        frames: of the view; no file has more.
        ended: whether its recording has ended, so that frames missing in its files are a gap.

    Raises:
        UsageError: the files are of something else, or split in another way.
    """
    numbers = {path: part_number(path, view) for path in files}
    parts: list[tuple[Path, int]] = []
    stale: list[Path] = []
    first = 0
    while True:
        path = folder / part_name(view, None if split is None else len(parts))
        kept = aside_path(path)
        attempts = [p for p in (path, partial_path(path), kept) if p in files]
        later = [p for p, number in numbers.items() if number is not None and number > len(parts)]
        log = max(attempts, key=lambda p: files[p].stop_from(first), default=path)
        stop = files[log].stop_from(first) if attempts else first
        if stop > first:
            found = _recording_metadata(log) or {}
            for key, value in recording.metadata(view, first).record().items():
                if found.get(key) != value:
                    raise UsageError(
                        f"{log} cannot be continued: its {key} is {found.get(key)!r}, now it is "
                        f"{value!r}; use the same command and versions, or overwrite with --force"
                    )
        follows = any(files[p].end or p.suffix == ".mcap" for p in later)
        if stop > first and log == path and (follows or stop == frames or ended):
            parts.append((path, files[path].frames))
            stale += [kept] if kept in attempts else []
            first = stop
            if follows:
                continue
            return ViewResume(path, tuple(parts), first, stale=(*stale, *later), complete=True)
        # A file with its final name was finished once: it is not written over without --force.
        replaced = later if stop > first else [*attempts, *later]
        if finished := [p for p in replaced if p.suffix == ".mcap"]:
            raise UsageError(
                f"{finished[0]} is there, but not frame {stop} of {view} before it: recover that "
                "part, or overwrite with --force"
            )
        if stop > first:
            return ViewResume(path, tuple(parts), first, log, stop, (*stale, *later))
        return ViewResume(path, tuple(parts), first, stale=(*stale, *attempts, *later))


def finished_logs(folder: Path) -> list[tuple[str, Path, int]]:
    """List view, file and frames of each log of a complete recording; nothing of another.

    Raises:
        LogDamagedError: the disk does not give a log.
    """
    if not folder.is_dir() or (folder / RECORDING).exists():
        return []
    logs: list[tuple[str, Path, int]] = []
    stops: dict[str, int] = {}
    stated: ViewMetadata | None = None
    for path in sorted(logs_in(folder), key=lambda path: (len(path.name), path.name)):
        record = _recording_metadata(path)
        if path.suffix != ".mcap" or record is None:
            return []
        stated = ViewMetadata.parse(path, record)
        held = frames_held(path, stated.view, gaps=stated.gaps)
        if held.stop_from(stops.get(stated.view, 0)) != held.end or not held.end:
            return []
        stops[stated.view] = held.stop
        logs.append((stated.view, path, held.frames))
    if stated is None or len(stops) != (len(stated.streams) or stated.stream_count):
        return []
    return logs if stated.gaps or len(set(stops.values())) == 1 else []


def other_recordings(folder: Path, recording: RecordingSpec) -> list[Path]:
    """List the logs in a folder that are of another recording.

    Raises:
        UsageError: one is readably of something else.
    """
    others = []
    for path in logs_in(folder):
        record = _recording_metadata(path)
        if record is None:
            continue
        view = record.get("view", "")
        stated = recording.metadata(view).record() if view in recording.spec.streams else {}
        mine = {k: v for k, v in stated.items() if k != "first_frame" and "version_" not in k}
        if not mine or any(record.get(key) != value for key, value in mine.items()):
            others.append(path)
    return others


def set_log_aside(place: ViewResume) -> Path | None:
    """Remove stale logs, and move the log to be resumed aside.

    Returns:
        Where that log is now, if there is one.

    Raises:
        LogWriteError: the disk does not allow it.
    """
    path, kept = place.path, aside_path(place.path)
    try:
        for old in place.stale:
            old.unlink()
        if place.log is None:
            return None
        if place.log != kept:
            os.replace(place.log, kept)
        for poorer in (path, partial_path(path)):
            poorer.unlink(missing_ok=True)
    except OSError as error:
        raise LogWriteError(f"{path} cannot be continued: {error.strerror}") from error
    return kept


def _opened(path: Path) -> LogReader | None:
    """Open a log, damaged or not; return None for a file that does not begin as one.

    Raises:
        LogDamagedError: the disk does not give it.
    """
    with opened_regular(path) as file:
        start = file.read(len(MAGIC))
    return LogReader(path, skip_damaged=True, check="chunks") if start == MAGIC else None


def _recording_metadata(path: Path) -> Mapping[str, str] | None:
    """Return the metadata of a recording's log; None if the log ends before it.

    Raises:
        UsageError: it is a log of something else.
    """
    log = _opened(path)
    if log is None:
        return None
    with log:
        if not log.metadata:
            return None
        if log.metadata[0].name != RECORDING_METADATA:
            raise UsageError(f"{path} is of no recording: choose another folder")
        return log.metadata[0].metadata
