"""The files of a recording as its views: which belong together, and in which order."""

from __future__ import annotations

import bisect
import itertools
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from foxglove_schemas_protobuf import PoseInFrame_pb2
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.blocks import HeadPose
from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from recorder.log.messages import POSE_TOPIC
from recorder.mcap.reader import LogReader
from recorder.mcap.store import PARTIAL
from replay.logs.formats.recording import ViewFile
from replay.logs.stream import LogStream, Rows, explained

_FURTHER_PART: Final = re.compile(rf".+-(?!000)\d{{3,}}\.mcap{re.escape(PARTIAL)}")

# Fewest bytes of a log of a recording whose header is written.
_SMALLEST: Final = 64

# Keys of a view's metadata that say what was recorded.
SCENE_KEYS: Final = ("scene", "seed", "config_sha256")

# Keys that are the same in all files of a recording.
_SAME: Final = ("truth", "fps", "start_ns", *SCENE_KEYS)


class SeveralRecordingsError(UsageError):
    """Recordings of images that were named together; they can be taken as external logs."""


def streams(views: Sequence[ViewFile], *, skip_damaged: bool = False) -> list[LogStream]:
    """Return the views of a recording as streams, whose rows are the numbers of frames.

    Args:
        views: the files, open.
        skip_damaged: frames may be missing between two parts.

    Raises:
        UsageError: the files are of several recordings.
        LogDamagedError: the files contradict each other.
    """
    return [_stream(parts) for parts in _arrange(views, skip_damaged=skip_damaged)]


def _stream(parts: Sequence[ViewFile]) -> LogStream:
    facts = parts[0].facts
    placed = sorted((*span, view) for view in parts for span in view.ranges)
    starts = [low for low, _, _ in placed]

    def read(rows: Rows) -> tuple[NDArray[Any], FloatArray]:
        frames = np.empty((len(rows), *facts.frame_shape), facts.dtype)
        truth = np.empty((len(rows), len(facts.truth)))
        at = 0
        while at < len(rows):
            first = int(rows[at])
            _, stop, view = placed[bisect.bisect_right(starts, first) - 1]
            end = min(at + stop - first, len(rows))
            if not isinstance(rows, range):  # frames may be left out
                numbers = rows[at:end]
                end = at + int(np.count_nonzero(numbers - np.arange(len(numbers)) == first))
            view.take(first, frames[at:end], truth[at:end])
            at = end
        return frames, truth

    return LogStream(
        path=parts[0].path,
        topic=facts.view,
        count=sum(view.count for view in parts),
        read=read,
        warnings=[text for view in parts for text in view.reader.warnings],
        views=parts,
    )


def _arrange(views: Sequence[ViewFile], *, skip_damaged: bool) -> list[list[ViewFile]]:
    """Return views by stream index, each as its parts by first frame; raises as `streams`."""
    by_view: dict[tuple[int, str], list[ViewFile]] = {}
    for view in views:
        by_view.setdefault((view.facts.stream_index, view.facts.view), []).append(view)
    indexes, names = zip(*by_view, strict=True)
    if len(set(indexes)) < len(indexes) or len(set(names)) < len(names):
        raise _unfit(
            views, views[0], "two files have the same stream: they are of different recordings"
        )
    first = views[0]
    for view in views[1:]:
        differ = [k for k in _SAME if getattr(first.facts, k) != getattr(view.facts, k)]
        if differ:
            what = f"not of the same recording as {first.path.name}: {differ[0]} differs"
            raise _unfit(views, view, what)
    arranged = []
    for stream in sorted(by_view):
        parts = sorted(by_view[stream], key=lambda view: view.facts.first_frame)
        for one, two in itertools.pairwise(parts):
            end = one.ranges[-1][1] if one.ranges else one.facts.first_frame
            begins = two.facts.first_frame
            if end > begins or (end < begins and not (skip_damaged or one.facts.gaps)):
                what = f"begins at frame {begins}, but {one.path.name} ends before frame {end}"
                raise _unfit(views, two, f"{what}: a part is missing or duplicated")
        arranged.append(parts)
    return arranged


def _unfit(views: Sequence[ViewFile], view: ViewFile, what: str) -> CdmisfaError:
    """Return the error about a file that does not belong to others; it names their folders."""
    folders = list(dict.fromkeys(str(view.path.parent) for view in views))
    if len(folders) < 2:
        return LogDamagedError(f"{view.path}: {what}")
    refused = f"{folders[0]} and {folders[1]} are different recordings: give one of them"
    if not views[0].facts.spec.images:
        return UsageError(refused)
    return SeveralRecordingsError(f"{refused}, or align their streams with --align index")


def has_no_frames(path: Path) -> bool:
    """Return whether a file is a later part of a recording that has no frames yet."""
    if not _FURTHER_PART.fullmatch(path.name):
        return False
    try:
        with LogReader(path) as reader:
            return not reader.segments
    except LogDamagedError:
        return path.stat().st_size < _SMALLEST


def first_pose(reader: LogReader) -> HeadPose | None:
    """Return where the head is in a view's log, None if the log does not state it.

    Raises:
        LogDamagedError: the log cannot be read.
    """
    entry = next(reader.messages({POSE_TOPIC}), None)
    if entry is None:
        return None
    with explained(f"{reader.path} {POSE_TOPIC}", "protobuf"):
        pose = PoseInFrame_pb2.PoseInFrame.FromString(entry.data).pose
    place, turn = pose.position, pose.orientation
    return HeadPose((place.x, place.y, place.z), (turn.x, turn.y, turn.z, turn.w))
