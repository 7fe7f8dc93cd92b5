"""A recording as a source of frames: the learner cannot tell it from the live scene."""

from __future__ import annotations

import bisect
import filecmp
import functools
import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from foxglove_schemas_protobuf import PoseInFrame_pb2
from google.protobuf import message

from cdmisfa.core.blocks import Block, HeadPose, freeze
from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.untrusted import parse_json
from recorder.log.messages import POSE_TOPIC
from recorder.log.scenery import turns_of
from recorder.log.viewlog import CONFIG_NAME
from recorder.mcap.reader import LogReader
from recorder.mcap.store import PARTIAL
from replay.recordings.view_file import ViewFile, intersection
from replay.storage.identity import Identity, LoggedSource, LogIdentity
from replay.storage.opening import log_files
from replay.stored import merged


def first_pose(reader: LogReader) -> HeadPose | None:
    """Where the head is in a view's log, None where it does not say it.

    Raises:
        LogDamagedError: it cannot be read.
    """
    entry = next(reader.messages({POSE_TOPIC}), None)
    if entry is None:
        return None
    try:
        pose = PoseInFrame_pb2.PoseInFrame.FromString(entry.data).pose
    except message.DecodeError as error:
        raise LogDamagedError(f"{reader.path} {POSE_TOPIC}: not a foxglove.PoseInFrame") from error
    place, turn = pose.position, pose.orientation
    return HeadPose((place.x, place.y, place.z), (turn.x, turn.y, turn.z, turn.w))


_FURTHER_PART: Final = re.compile(rf".+-(?!000)\d{{3,}}\.mcap{re.escape(PARTIAL)}")
_SMALLEST: Final = 64
"""Bytes that no log of a recording has less of once its header is written."""
_SCENE: Final = ("scene", "seed", "config_sha256")
_SAME: Final = ("frame_shape", "dtype", "truth", "fps", "start_ns", "gaps", *_SCENE)


class SeveralRecordingsError(UsageError):
    """Recordings of images that were named together; they can be taken as camera logs are."""


class RecordedSource(LoggedSource):
    """The views of a recording on their common clock.

    Args:
        paths: a recording's folder, or the files of its views, finished or `.partial`; or an
            URLs.
        loop: begin again at the end instead of stopping there.
        salvage: leave out, in every view, what is damaged in one of them.
        opened: views that were opened already.

    Attributes:
        gaps: whether the recording is of live streams, which may lack frames.
        warnings: what the user should know: files that were cut, frames left out.
    """

    more = "record more frames, or "

    def __init__(
        self,
        paths: str | Path | Iterable[str | Path],
        *,
        loop: bool = False,
        salvage: bool = False,
        opened: Iterable[ViewFile] = (),
    ) -> None:
        """Open every view and check that they belong together.

        Raises:
            UsageError: no such recording, or several.
            LogDamagedError: a file is damaged, or the files of a folder contradict each other.
        """
        self._loop = loop
        self._files = [path for path in log_files(paths) if not _only_begun(path)]
        known = {view.path: view for view in opened}
        views: list[ViewFile] = []
        try:
            for path in self._files:
                view = known.get(path)
                views.append(view or ViewFile(path, salvage=salvage))
            self._views = _arrange(views, salvage=salvage)
            self._set_clock()
        except BaseException:
            for view in views:
                view.close()
            raise
        self._t = self._first

    def coverage(self) -> dict[str, list[tuple[int, int]]]:
        """The frames that are there of each view, as ranges [start, stop)."""
        return {p[0].facts.view: [r for view in p for r in view.ranges] for p in self._views}

    def _logs(self) -> list[Identity]:
        return [LogIdentity(view.reader) for view in self._all()]

    def _described(self, logs: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
        """The recording's views with their files, and what was recorded."""
        return {
            "kind": "recording",
            **self.scene(),
            "frames": self._count,
            "first_frame": self._first,
            "loop": self._loop,
            "views": self._views_with(logs),
        }

    def scene(self) -> Mapping[str, str]:
        """What was recorded: the scene, its seed and the checksum of its configuration."""
        facts = self._views[0][0].facts
        return {name: getattr(facts, name) for name in _SCENE if name in facts.values}

    def origin(self) -> Mapping[str, Any]:
        """What the source of which this was recorded said of itself; empty of scenes."""
        return self._stated("source")

    @functools.cached_property
    def turns(self) -> tuple[tuple[int, ...], ...]:
        """Frames that are lost between each two views, as in the scene; see `turn_to`."""
        return turns_of(self._stated("scene"), [view[0].facts.stream_index for view in self._views])

    def _stated(self, section: str) -> Mapping[str, Any]:
        """A section of the recording's configuration; empty where it has none."""
        reader = self._views[0][0].reader
        own = next((one for one in reader.attachments if one.name == CONFIG_NAME), None)
        if own is None:
            return {}
        try:
            stated = parse_json(bytes(reader.attachment_data(own)))[section]
        except (ValueError, LookupError, TypeError):
            return {}
        return stated if isinstance(stated, dict) else {}

    def close(self) -> None:
        for view in self._all():
            view.close()

    def _block(self, stream: int, t: int, n: int) -> Block:
        frames = np.empty((n, *self._spec.frame_shape), self._spec.dtype)
        truth = np.empty((n, len(self._spec.truth)))
        at, played = 0, t - self._first
        while at < n:
            view, frame, count = self._place(stream, (played + at) % self._count, n - at)
            view.take(frame, frames[at : at + count], truth[at : at + count])
            at += count
        return Block(stream, t, freeze(frames), freeze(truth))

    def _views_with(self, logs: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        named = zip(self._all(), logs, strict=True)
        return [{"name": view.facts.view, "frames": view.count, **log} for view, log in named]

    def _all(self) -> list[ViewFile]:
        return [view for parts in self._views for view in parts]

    def _name(self) -> str:
        parents = {path.parent for path in self._files}
        return str(self._files[0]) if len(self._files) == 1 else min(map(str, parents))

    def _set_clock(self) -> None:
        """Find the frames that every view has, whole."""
        coverage = self.coverage()
        covered = list(coverage.values())
        self._held = [merged(ranges) for ranges in covered]
        self.gaps = self._views[0][0].facts.gaps
        common = self._whole() if self.gaps else functools.reduce(intersection, covered)
        if not common:
            raise LogDamagedError(f"{self._name()}: no frame is there, whole, in every view")
        self._ranges = merged(common)
        lengths = (stop - start for start, stop in self._ranges)
        self._range_starts = list(itertools.accumulate(lengths, initial=0))
        self._first = self._ranges[0][0]
        self._count = self._range_starts[-1]
        warnings = [text for view in self._all() for text in view.reader.warnings]
        if not self.gaps and len({ranges[-1][1] for ranges in covered}) > 1:
            warnings.append(
                f"{self._name()}: its views end at different frames; it ends with the shortest, "
                f"before frame {self._ranges[-1][1]}"
            )
        left_out = self._ranges[-1][1] - self._first - self._count
        if left_out:
            warnings.append(
                f"{self._name()}: {left_out} frames are missing in a view and left out in all"
            )
        self.warnings = tuple(warnings)
        length = None if self._loop else self._count
        one = self._views[0][0].facts.spec
        self._spec = replace(one, streams=tuple(coverage), length=length)

    def _whole(self) -> list[tuple[int, int]]:
        """All frames of the clock, from the first to the last that any view has."""
        end = max((high for ranges in self._held for _, high in ranges), default=0)
        first = self._views[0][0].facts.first_frame
        return [(first, end)] if first < end else []

    def _place(self, stream: int, played: int, wanted: int) -> tuple[ViewFile, int, int]:
        """Find the frame that is `played` frames from the start: file, frame, how many follow."""
        number = bisect.bisect_right(self._range_starts, played) - 1
        low, high = self._ranges[number]
        frame = low + played - self._range_starts[number]
        for view in self._views[stream]:
            for start, stop in view.ranges:
                if start <= frame < stop:
                    return view, frame, min(wanted, min(high, stop) - frame)
        raise AssertionError(f"frame {frame} is in no file")


def _only_begun(path: Path) -> bool:
    """Whether a file is a further part that its recorder had begun, but not a frame of it."""
    if not _FURTHER_PART.fullmatch(path.name):
        return False
    try:
        with LogReader(path) as reader:
            return not reader.segments
    except LogDamagedError:
        return path.stat().st_size < _SMALLEST


def _arrange(opened: list[ViewFile], *, salvage: bool) -> list[list[ViewFile]]:
    """Views by stream index, each as its parts by first frame."""
    by_view: dict[tuple[int, str], list[ViewFile]] = {}
    for view in opened:
        by_view.setdefault((view.facts.stream_index, view.facts.view), []).append(view)
    indexes = [index for index, _ in by_view]
    names = [name for _, name in by_view]
    if len(set(indexes)) < len(indexes) or len(set(names)) < len(names):
        raise _of_several(opened) or LogDamagedError(
            f"{opened[0].path}: its files are not of one recording: two claim the same stream"
        )
    first = opened[0]
    for view in opened[1:]:
        facts = [first.facts, view.facts]
        differ = [k for k in _SAME if getattr(facts[0], k) != getattr(facts[1], k)]
        if differ:
            raise _of_several(opened) or LogDamagedError(
                f"{view.path}: not of the same recording as {first.path.name}: {differ[0]} differs"
            )
    arranged = []
    for stream in sorted(by_view):
        parts = sorted(by_view[stream], key=lambda v: v.facts.first_frame)
        for one, two in itertools.pairwise(parts):
            end = one.ranges[-1][1] if one.ranges else one.facts.first_frame
            if end > two.facts.first_frame or (end < two.facts.first_frame and not salvage):
                raise _of_several(opened) or LogDamagedError(
                    f"{two.path}: begins at frame {two.facts.first_frame}, {one.path.name} ends "
                    f"before {end}: a part is missing or doubled"
                )
        arranged.append(parts)
    return arranged


def _of_several(opened: Sequence[ViewFile]) -> UsageError | None:
    """The refusal of files that do not belong together; None of different ones in one folder."""
    paths = [str(view.path) for view in opened]
    for number, path in enumerate(paths):
        if path in paths[:number]:
            return UsageError(f"{path} is named twice: leave one out")
    copied = _copied([view.path for view in opened])
    folders = list(dict.fromkeys(str(view.path.parent) for view in opened))
    if len(folders) < 2:
        return UsageError(copied) if copied else None
    refused = (
        copied or f"{folders[0]} and {folders[1]} are recordings of their own: name one of them"
    )
    if not opened[0].facts.spec.images:
        return UsageError(refused)
    return SeveralRecordingsError(
        f"{refused}, or put their streams on one clock with --align index"
    )


def _copied(paths: Sequence[Path]) -> str:
    """Which file is a copy of another, byte for byte; "" where none is."""
    for one, two in itertools.combinations(paths, 2):
        if filecmp.cmp(one, two, shallow=False):
            return f"{two} is a copy of {one}: leave one out"
    return ""
