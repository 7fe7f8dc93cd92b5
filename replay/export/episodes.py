"""Which frames of which logs an export of many holds: whole recordings, or listed segments."""

from __future__ import annotations

import contextlib
from collections.abc import Generator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np

from cdmisfa.core.errors import UsageError
from replay.camera_logs.opening import only_foreign
from replay.camera_logs.options import CameraOptions
from replay.export.frames import shared_spans
from replay.inputs import About, Logged, open_to_look
from replay.recordings.source import RecordedSource
from replay.recordings.view_file import NoRecordingError, intersection
from replay.segments import read_segments
from replay.storage.location import Location
from replay.stored import Span

_ALIKE: Final = ("streams", "frame_shape", "dtype", "truth", "fps")
"""What logs have in common that are exported together."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """What is wanted of a log.

    Attributes:
        name: the log's, for errors.
        files: what is opened as one.
        times: log times [start, stop), nanoseconds; empty for all.
        topics: only these, or of these patterns; empty for all.
    """

    name: str
    files: list[Location]
    times: list[Span] = field(default_factory=list)
    topics: list[str] = field(default_factory=list)


def recordings_apart(paths: Sequence[Path]) -> list[Wanted]:
    """Folders of recordings, each a log; nothing where there is one, or another log among them."""
    if len(paths) < 2 or not all(path.is_dir() and not only_foreign(path) for path in paths):
        return []
    try:
        for path in paths:
            RecordedSource(path).close()
    except NoRecordingError:
        return []
    return [Wanted(str(path), [path]) for path in paths]


def logs_of_segments(listed: Path) -> list[Wanted]:
    """The logs of a list of segments, in its order; what names one `log` is opened as one.

    Raises:
        UsageError: it is no such list, or a segment names no file.
    """
    found: dict[str, Wanted] = {}
    for place, segment in read_segments(listed):
        if place is None:
            raise UsageError(f"{listed}: a segment names no log: give each row a path")
        name = segment.log or str(place)
        own = found.setdefault(name, Wanted(name, []))
        if place not in own.files:
            own.files.append(place)
        if (times := (segment.start, segment.stop)) not in own.times:
            own.times.append(times)
        if segment.topic not in own.topics:
            own.topics.append(segment.topic)
    for own in found.values():
        if "*" in own.topics:
            own.topics.clear()
    return list(found.values())


def opened_in_turn(
    logs: Sequence[Wanted], cameras: CameraOptions | None, about: About
) -> Generator[tuple[Logged, list[Span]]]:
    """Each log, open until the next is asked for, with the frames [start, stop) that are wanted.

    Raises:
        UsageError: a log has none of them, or other streams, sizes or rates than the first, or as
            for `open_to_look`.
        LogDamagedError: a log is damaged.
    """
    first = None
    for log in logs:
        options = cameras or CameraOptions()
        if log.topics:
            options = replace(options, topics=tuple(log.topics))
        with contextlib.closing(open_to_look(log.files, options)) as source:
            about(source)
            first = source.spec if first is None else first
            for what in _ALIKE:
                one, other = getattr(first, what), getattr(source.spec, what)
                if one != other:
                    raise UsageError(
                        f"{log.name}: its {what} is {other}, that of {logs[0].name} {one}: export "
                        "them by themselves, or convert them first"
                    )
            yield source, _frames(source, log)


def _frames(source: Logged, log: Wanted) -> list[Span]:
    held, first = shared_spans(source), source.first_frame
    if not log.times:
        return held
    times = source.spec.times(first, first + source.frames)
    found: list[Span] = []
    for start, stop in log.times:
        low, high = np.searchsorted(times, [start, min(stop, 2**63 - 1)]).tolist()
        found += intersection([(first + low, first + high)], held)
    if not found:
        raise UsageError(f"{log.name}: no frame of it lies in its segments")
    return found
