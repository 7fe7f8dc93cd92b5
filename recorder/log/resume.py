"""Resume a recording: find the frames that an earlier attempt left, and continue after them.

The logs of an attempt are read in file order up to the first damage. A log that is resumed is
renamed while its frames are copied into a new log, which therefore has the same bytes as a log that
was never interrupted.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from cdmisfa.core.errors import UsageError
from cdmisfa.core.untrusted import opened_regular
from recorder.log.files import (
    RECORDING,
    aside_path,
    logs_in,
    part_name,
    part_number,
    partial_path,
    view_logs,
    writing,
)
from recorder.log.manifest import RecordingSpec, ViewMetadata, read_start
from recorder.log.messages import RECORDING_METADATA, view_topic
from recorder.mcap.reader import LogReader
from recorder.mcap.records import MAGIC


class StoredFrames(NamedTuple):
    """The frames in an earlier log of a view.

    Attributes:
        first: number of the first frame.
        stop: the frames [first, stop) are complete, except for gaps of the source.
        end: number after the last frame; 0 without frames.
        gaps: True if frames of the source can be missing, also the first frame of a log.
        frames: number of frames in [first, stop).
    """

    first: int
    stop: int
    end: int
    gaps: bool = False
    frames: int = 0

    def stop_from(self, first: int) -> int:
        """Return the number after the last frame that follows `first` without a missing frame."""
        follows = self.first == first or (self.gaps and self.first > first)
        return self.stop if self.end and follows else first


def stored_frames(path: Path, view: str, *, gaps: bool = False) -> StoredFrames:
    """Return the frames of a view in a log, which may be damaged.

    Args:
        path: the log.
        view: name of the view.
        gaps: True if frames of the source can be missing.
    """
    first = stop = end = count = 0
    for topic, frame, _, _ in messages(path):
        if topic == view_topic(view):
            first, stop = (first, stop) if end else (frame, frame)
            if frame == stop or (gaps and frame > stop):
                stop, count = frame + 1, count + 1
            end = max(end, frame + 1)
    return StoredFrames(first, stop, end, gaps, count)


def messages(path: Path) -> Iterator[tuple[str, int, int, bytes]]:
    """Yield the messages of a log in file order, up to the first damage.

    Yields:
        Topic, sequence number, log time (ns) and data of each message.

    Raises:
        LogDamagedError: the disk cannot read the file.
    """
    log = _opened(path)
    if log is None:
        return
    with log:
        for segment in log.segments:
            # Stop at damage: a missing frame would shift all later frames.
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
    """File and frame at which a view begins or is resumed.

    Attributes:
        path: file of the part to write.
        parts: file and number of frames of each finished part.
        first: first frame of the part to write.
        log: the earlier log with the most frames of that part; None if there is none.
        stop: the earlier log has the frames [first, stop).
        stale: logs that are not needed.
        complete: True if the finished parts are the whole view.
    """

    path: Path
    parts: tuple[tuple[Path, int], ...] = ()
    first: int = 0
    log: Path | None = None
    stop: int = 0
    stale: tuple[Path, ...] = ()
    complete: bool = False


def begin_view(folder: Path, view: str, split: float | None, first: int = 0) -> ViewResume:
    """Return the beginning of a view that has no files yet."""
    return ViewResume(folder / part_name(view, None if split is None else 0), first=first)


def resume_views(
    folder: Path,
    recording: RecordingSpec,
    views: Sequence[str],
    split: float | None,
    frames: int | None,
    default: int,
) -> tuple[dict[str, ViewResume], float | None, int]:
    """Find where each view of a recording is resumed; change no file.

    Args:
        folder: folder of the recording.
        recording: specification of the recording.
        views: names of the views.
        split: length of a part (s); None: as at the start of the recording.
        frames: number of frames of each view; None: as at the start of the recording.
        default: number of frames of each view if the recording does not state it.

    Returns:
        File and frame of each view, length of a part (s), and number of frames of each view.

    Raises:
        UsageError: the recording was started with another source, seed or split, has more frames,
            or there are files of another recording.
    """
    start = read_start(folder)
    limit = min((start.split[view] for view in views if view in start.split), default=None)
    split = limit if split is None else split
    if limit not in (None, split):
        raise UsageError(
            f"{folder} was started with --split {limit:g}s, not --split {split:g}s: use the same, "
            "or overwrite with --force"
        )
    earlier = {
        view: {path: stored_frames(path, view, gaps=recording.gaps) for path in logs}
        for view, logs in view_logs(folder, views).items()
    }
    lengths = [start.frames[view] for view in views if view in start.frames]
    finished = all(
        files and all(path.suffix == ".mcap" for path in files) for files in earlier.values()
    )
    if not finished and not lengths:
        lengths = [default]
    for path, stored in itertools.chain(*(files.items() for files in earlier.values())):
        if frames is not None and stored.end > frames:
            raise UsageError(
                f"{path} has {stored.end} frames, more than --frames {frames}, and --resume cannot "
                f"shorten it: give --frames {stored.end} or more, or overwrite with --force"
            )
        lengths.append(stored.end)
    frames = frames or max(lengths)
    places = {}
    misfits: list[Path] = []
    for view, files in earlier.items():
        misfits += [p for p in files if (part_number(p, view) is None) != (split is None)]
        if not misfits:
            ended = recording.gaps and view not in start.frames
            places[view] = _resume_view(folder, view, recording, split, files, frames, ended=ended)
    if misfits := misfits or other_recordings(folder, recording):
        raise UsageError(
            f"{misfits[0]} belongs to another recording or has another --split: use the "
            "same, or overwrite with --force"
        )
    return places, split, frames


def _resume_view(
    folder: Path,
    view: str,
    recording: RecordingSpec,
    split: float | None,
    files: Mapping[Path, StoredFrames],
    frames: int,
    *,
    ended: bool,
) -> ViewResume:
    """Skip the finished parts of a view, and find where to resume it.

    Args:
        folder: folder of the recording.
        view: name of the view.
        recording: specification of the recording.
        split: length of a part (s).
        files: all files of the view, and the frames in each.
        frames: number of frames of the view; no file has more.
        ended: True if the recording has ended, so that missing frames are gaps of the source.

    Raises:
        UsageError: the files are of another recording, or split in another way.
    """
    numbers = {path: part_number(path, view) for path in files}
    parts: list[tuple[Path, int]] = []
    stale: list[Path] = []
    first = 0
    while True:
        path = folder / part_name(view, None if split is None else len(parts))
        aside = aside_path(path)
        attempts = [p for p in (path, partial_path(path), aside) if p in files]
        later = [p for p, number in numbers.items() if number is not None and number > len(parts)]
        log = max(attempts, key=lambda p: files[p].stop_from(first), default=path)
        stop = files[log].stop_from(first) if attempts else first
        if stop > first:
            stated = _recording_metadata(log) or {}
            for key, value in recording.metadata(view, first).record().items():
                if stated.get(key) != value:
                    raise UsageError(
                        f"{log} cannot be resumed: its {key} is {stated.get(key)!r}, not "
                        f"{value!r}: use the same command and versions, or overwrite with --force"
                    )
        follows = any(files[p].end or p.suffix == ".mcap" for p in later)
        if stop > first and log == path and (follows or stop == frames or ended):
            parts.append((path, files[path].frames))
            stale += [aside] if aside in attempts else []
            first = stop
            if follows:
                continue
            return ViewResume(path, tuple(parts), first, stale=(*stale, *later), complete=True)
        # A file with its final name was complete once: only --force may overwrite it.
        replaced = later if stop > first else [*attempts, *later]
        if finished := [p for p in replaced if p.suffix == ".mcap"]:
            raise UsageError(
                f"{finished[0]} exists, but frame {stop} of {view} before it is missing: recover "
                "that part, or overwrite with --force"
            )
        copied, end = (log, stop) if stop > first else (None, 0)
        return ViewResume(path, tuple(parts), first, copied, end, (*stale, *replaced))


def finished_logs(folder: Path) -> list[tuple[str, Path, int]]:
    """Return view, file and number of frames of each log of a complete recording; else nothing.

    Raises:
        LogDamagedError: the disk cannot read a log.
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
        stored = stored_frames(path, stated.view, gaps=stated.gaps)
        if stored.stop_from(stops.get(stated.view, 0)) != stored.end or not stored.end:
            return []
        stops[stated.view] = stored.stop
        logs.append((stated.view, path, stored.frames))
    if stated is None or len(stops) != (len(stated.streams) or stated.stream_count):
        return []
    return logs if stated.gaps or len(set(stops.values())) == 1 else []


def other_recordings(folder: Path, recording: RecordingSpec) -> list[Path]:
    """Return the logs in a folder that belong to another recording.

    Raises:
        UsageError: a log is not of a recording.
    """
    foreign = []
    for path in logs_in(folder):
        record = _recording_metadata(path)
        if record is None:
            continue
        view = record.get("view", "")
        stated = recording.metadata(view).record() if view in recording.spec.streams else {}
        expected = {k: v for k, v in stated.items() if k != "first_frame" and "version_" not in k}
        if not expected or any(record.get(key) != value for key, value in expected.items()):
            foreign.append(path)
    return foreign


def set_log_aside(place: ViewResume) -> Path | None:
    """Remove stale logs, and rename the log to be resumed.

    Returns:
        The new name of that log; None if there is none.

    Raises:
        LogWriteError: a file cannot be removed or renamed.
    """
    path, aside = place.path, aside_path(place.path)
    with writing(path):
        for old in place.stale:
            old.unlink()
        if place.log is None:
            return None
        if place.log != aside:
            os.replace(place.log, aside)
        for shorter in (path, partial_path(path)):
            shorter.unlink(missing_ok=True)
    return aside


def _opened(path: Path) -> LogReader | None:
    """Open a log, which may be damaged; return None if the file does not begin as a log.

    Raises:
        LogDamagedError: the disk cannot read the file.
    """
    with opened_regular(path) as file:
        start = file.read(len(MAGIC))
    return LogReader(path, skip_damaged=True, check="chunks") if start == MAGIC else None


def _recording_metadata(path: Path) -> Mapping[str, str] | None:
    """Return the metadata of a recording's log; None if the log ends before them.

    Raises:
        UsageError: the log is not of a recording.
    """
    log = _opened(path)
    if log is None:
        return None
    with log:
        if not log.metadata:
            return None
        if log.metadata[0].name != RECORDING_METADATA:
            raise UsageError(f"{path} does not belong to a recording: choose another folder")
        return log.metadata[0].metadata
