"""What an earlier attempt at a view left, and where it is resumed.

The logs of an attempt are read in the order of the file, up to where they are damaged or torn. A
log that is resumed is kept aside while its frames are copied into a new one, which so has the
bytes of a log that was never interrupted.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import zstandard
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader
from mcap.records import Channel, Message

from cdmisfa.core.errors import LogDamagedError, LogWriteError, UsageError
from recorder.log.begun import Begun, read_recording
from recorder.log.folder import RECORDING, logs_in, part_name, part_number, view_logs
from recorder.log.messages import RECORDING_METADATA, view_topic
from recorder.log.split import Split
from recorder.log.viewfacts import Identity, ViewFacts
from recorder.log.whole import partial_path

_DAMAGE = (
    *(McapError, ValueError, struct.error, OverflowError, MemoryError, KeyError, EOFError),
    *(zstandard.ZstdError, RuntimeError),  # of data that lz4 cannot unpack, the latter
)


_LEAST = 64
"""Bytes that no log has less of once its header and metadata are written."""


class FramesHeld(NamedTuple):
    """What an earlier log of a view holds.

    Attributes:
        first: its first frame.
        stop: its frames [first, stop) are all there, except those of gaps.
        end: one more than its last frame; 0 without any.
        gaps: whether the source may lack frames, the first of a log, too.
        frames: how many of [first, stop) are there.
    """

    first: int
    stop: int
    end: int
    gaps: bool = False
    frames: int = 0

    def whole(self, first: int) -> int:
        """Up to before which frame all from a given one on are there."""
        follows = self.first == first or (self.gaps and self.first > first)
        return self.stop if self.end and follows else first


Earlier = Mapping[str, Mapping[Path, FramesHeld]]
"""What the files of each view hold that an earlier attempt left."""


def frames_held(path: Path, view: str, *, gaps: bool = False) -> FramesHeld:
    """Read once through a log, damaged or not, for the frames of a view that it holds.

    Args:
        path: the log.
        view: name of the view.
        gaps: whether the source may lack frames.
    """
    first = stop = end = count = 0
    for channel, message in messages(path):
        if channel.topic == view_topic(view):
            if not end:
                first = stop = message.sequence
            if message.sequence == stop or (gaps and message.sequence > stop):
                stop, count = message.sequence + 1, count + 1
            end = max(end, message.sequence + 1)
    return FramesHeld(first, stop, end, gaps, count)


@dataclass(frozen=True, slots=True)
class Resume:
    """Where a view is begun or resumed.

    Attributes:
        path: file of the part to write.
        parts: file and number of frames of each part that is finished.
        first: first frame of the part to write.
        log: the earlier log that holds the most frames of that part, where one does.
        stop: it holds [first, stop).
        stale: logs of which nothing is needed.
        complete: whether the parts are the whole view, and nothing is to be written.
    """

    path: Path
    parts: tuple[tuple[Path, int], ...]
    first: int
    log: Path | None = None
    stop: int = 0
    stale: tuple[Path, ...] = ()
    complete: bool = False


def resume_view(
    folder: Path,
    view: str,
    identity: Identity,
    split: Split | None,
    there: Mapping[Path, FramesHeld],
    frames: int,
    *,
    ended: bool = False,
) -> Resume:
    """Pass over the parts that are finished, and find where to resume. Changes nothing.

    Args:
        folder: of the recording.
        view: name of the view.
        identity: what is recorded.
        split: where parts end.
        there: all of the view's files, and what they hold.
        frames: how many the view shall have; no file has more.
        ended: whether its recording has ended, so that what its files lack is a gap.

    Raises:
        UsageError: what is there is something else, or split in another way.
    """
    length = split.frames(identity.spec.fps) if split else None
    numbers = {path: part_number(path, view) for path in there}
    other = next((p for p, number in numbers.items() if (number is None) != (split is None)), None)
    if other is not None:
        raise UsageError(
            f"{other} was recorded {'with' if split is None else 'without'} --split: "
            "use the same, or overwrite with --force"
        )
    parts: list[tuple[Path, int]] = []
    copied: list[Path] = []
    first = 0
    while True:
        path = folder / part_name(view, None if split is None else len(parts))
        attempts = (path, partial_path(path), aside_path(path))
        found = {p: there[p].whole(first) for p in attempts if p in there}
        later = [p for p, number in numbers.items() if number is not None and number > len(parts)]
        best = max(found, key=lambda p: found[p], default=path)
        stop = found.get(best, first)
        if stop == first:
            if path in found:
                raise UsageError(
                    f"{path} holds no frames of {view} from {first} on: overwrite with --force"
                )
            place = Resume(path, tuple(parts), first, stale=(*copied, *found, *later))
            break
        _refuse_other(best, identity.facts(view, first))
        follows = best == path and bool(later)
        wrong = length is not None and (
            stop - first > length or (follows and stop - first != length)
        )
        if wrong and not identity.gaps:
            raise UsageError(
                f"{best} has {stop - first} frames, with this --split it would have {length}: "
                "use the same, or overwrite with --force"
            )
        if best == path and (stop == frames or ended) and not follows:
            copied += [p for p in found if p == aside_path(path)]
            parts.append((path, there[path].frames))
            return Resume(path, tuple(parts), stop, stale=tuple(copied), complete=True)
        if not follows:
            place = Resume(path, tuple(parts), first, best, stop, (*copied, *later))
            break
        if stop >= frames:
            raise UsageError(
                f"{path} ends at frame {stop}, and more follow: ask for more frames, "
                "or overwrite with --force"
            )
        copied += [p for p in found if p == aside_path(path)]
        parts.append((path, there[path].frames))
        first = stop
    finished = next((p for p in later if p.suffix == ".mcap"), None)
    if finished is not None:
        raise UsageError(
            f"{finished} is there, {path.name} before it is not whole: recover that "
            "part first, or overwrite with --force"
        )
    return place


def resume_views(
    folder: Path,
    identity: Identity,
    views: Sequence[str],
    split: Split | None,
    frames: int | None,
    default: int,
) -> tuple[dict[str, Resume], Split | None, int]:
    """Find where each view of a recording is resumed. Changes nothing.

    Args:
        folder: of the recording.
        identity: what is recorded.
        views: names of the views.
        split: where parts end; None for where they did.
        frames: how many each view shall have; None for as many as it was begun with.
        default: as many, where the recording does not say how it was begun.

    Returns:
        The place of each view, where parts end, and the frames of each view.

    Raises:
        UsageError: it was begun with another source, seed or split, has more frames, or there are
            files of another recording.
    """
    begun = read_recording(folder)
    earlier, split, frames = _as_begun(folder, begun, identity, views, split, frames, default)
    places = {}
    for view, there in earlier.items():
        ended = identity.gaps and view not in begun.options["frames"]
        places[view] = resume_view(folder, view, identity, split, there, frames, ended=ended)
    if others := other_recordings(folder, identity):
        raise UsageError(f"{others[0]} is of another recording: overwrite with --force")
    return places, split, frames


def _as_begun(
    folder: Path,
    begun: Begun,
    identity: Identity,
    views: Sequence[str],
    split: Split | None,
    frames: int | None,
    default: int,
) -> tuple[Earlier, Split | None, int]:
    """What there is of a recording that is resumed, where its parts end, and its frames.

    Raises:
        UsageError: it was begun with another scene, seed or split, or has more frames.
    """
    limits, lengths = (
        [begun.options[name][view] for view in views if view in begun.options[name]]
        for name in ("split", "frames")
    )
    limit = min(limits, default=None)
    kind, seed = identity.kind, identity.seed
    for option, before, now in (
        ("", "".join(begun.source) or kind, kind),
        ("--seed ", begun.options.get("seed", seed), seed),
        ("--split ", limit, limit if split is None else str(split)),
    ):
        if before not in (None, now):
            raise UsageError(
                f"{folder} was begun with {option}{before}, not {option}{now}: go on with the "
                "same, or overwrite with --force"
            )
    if split is None and limit is not None:
        split = Split.parse(limit)
    earlier = {
        view: {path: frames_held(path, view, gaps=identity.gaps) for path in logs}
        for view, logs in view_logs(folder, views).items()
    }
    unfinished = not all(
        files and all(p.suffix == ".mcap" for p in files) for files in earlier.values()
    )
    if unfinished and not lengths:
        lengths = [default]
    for path, there in (item for files in earlier.values() for item in files.items()):
        if frames is not None and there.end > frames:
            raise UsageError(
                f"{path} holds {there.end} frames, more than --frames {frames}: --resume shortens "
                f"nothing, give --frames {there.end} or more, or overwrite with --force"
            )
        lengths.append(there.end)
    return earlier, split, frames or max(lengths)


def finished_logs(folder: Path) -> list[tuple[str, Path, int]]:
    """View, file and frames of each log of a recording that is complete; none of another.

    Raises:
        LogDamagedError: the disk does not give a log.
    """
    logs = logs_in(folder) if folder.is_dir() and not (folder / RECORDING).exists() else []
    found: list[tuple[str, Path, int]] = []
    streams: set[str] = set()
    count, gaps = "", False
    stops: dict[str, int] = {}
    for path in sorted(logs, key=lambda path: (len(path.name), path.name)):
        record = next(_undamaged(path, NonSeekingReader.iter_metadata), None)
        if path.suffix != ".mcap" or record is None or record.name != RECORDING_METADATA:
            return []
        streams.update(filter(None, record.metadata.get("streams", "").split(",")))
        count = record.metadata.get("stream_count", "")
        gaps = record.metadata.get("gaps") == str(True)
        held = frames_held(path, view := record.metadata.get("view", ""), gaps=gaps)
        if held.whole(stops.get(view, 0)) != held.end or not held.end:
            return []
        stops[view] = held.stop
        found.append((view, path, held.frames))
    every = stops.keys() == streams if streams else str(len(stops)) == count
    return found if every and (gaps or len(set(stops.values())) == 1) else []


def other_recordings(folder: Path, identity: Identity) -> list[Path]:
    """Logs in a folder that are of another recording.

    Raises:
        UsageError: one is readably of something else.
    """
    others = []
    if not folder.is_dir():
        return []
    own = set(itertools.chain(*view_logs(folder, identity.spec.streams).values()))
    for path in logs_in(folder):
        record = next(_undamaged(path, NonSeekingReader.iter_metadata), None)
        if record is None:
            if path not in own and path.stat().st_size < _LEAST:
                others.append(path)  # begun, and killed before it said of what it is
            continue
        if record.name != RECORDING_METADATA:
            raise UsageError(f"{path} is of no recording: choose another folder")
        view = record.metadata.get("view", "")
        facts = identity.facts(view) if view in identity.spec.streams else None
        mine = {} if facts is None else replace(facts, first_frame=0, versions={}).as_metadata()
        if not mine or any(
            record.metadata.get(k) != v for k, v in mine.items() if k != "first_frame"
        ):
            others.append(path)
    return others


def set_log_aside(place: Resume) -> Path | None:
    """Remove what is stale, and move the log to be resumed aside.

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


def aside_path(path: Path) -> Path:
    """Where a partial is kept while its frames are copied into the new one."""
    return path.with_name(path.name + ".partial.kept")


def messages(path: Path) -> Iterator[tuple[Channel, Message]]:
    """Messages in the order of the file, up to where it is damaged or torn."""
    read = partial(NonSeekingReader.iter_messages, log_time_order=False)
    for _, channel, message in _undamaged(path, read):
        yield channel, message


def _undamaged(path: Path, read: Callable[[NonSeekingReader], Iterator[Any]]) -> Iterator[Any]:
    """What a reader of a log gives, up to where the log is damaged or torn.

    Raises:
        LogDamagedError: the disk does not give it, which says nothing of the log.
    """
    try:
        with contextlib.suppress(*_DAMAGE), path.open("rb") as file:
            yield from read(NonSeekingReader(file, validate_crcs=True, record_size_limit=2**30))
    except OSError as error:
        raise LogDamagedError(f"{path} cannot be read: {error.strerror}") from error


def _refuse_other(path: Path, facts: ViewFacts) -> None:
    """Refuse to resume a log that states other facts."""
    records = _undamaged(path, NonSeekingReader.iter_metadata)
    record = next((m for m in records if m.name == RECORDING_METADATA), None)
    if record is None:
        raise UsageError(f"{path} does not say what it is a recording of: overwrite with --force")
    for key, value in facts.as_metadata().items():
        if record.metadata.get(key) != value:
            raise UsageError(
                f"{path} cannot be continued: its {key} is {record.metadata.get(key)!r}, now it is "
                f"{value!r}; use the same command and versions, or overwrite with --force"
            )
