"""What an earlier attempt at a view left, and where it is resumed.

The logs of an attempt are read in the order of the file, up to where they are damaged or torn. A
log that is resumed is kept aside while its frames are copied into a new one, which so has the
bytes of a log that was never interrupted.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader
from mcap.records import Channel, Message

from cdmisfa.core.errors import UsageError
from recorder.log.folder import part_name, part_number
from recorder.log.messages import METADATA, view_topic
from recorder.log.split import Split
from recorder.log.viewfacts import Identity, ViewFacts
from recorder.log.whole import partial_path

_DAMAGE = (McapError, ValueError, struct.error, OSError, OverflowError, MemoryError, KeyError)
_RECORD_LIMIT = 2**30


class FramesHeld(NamedTuple):
    """What an earlier log of a view holds.

    Attributes:
        first: its first frame.
        stop: its frames [first, stop) are all there.
        end: one more than its last frame; 0 without any.
    """

    first: int
    stop: int
    end: int

    def whole(self, first: int) -> int:
        """Up to before which frame all from a given one on are there."""
        return self.stop if self.end and self.first == first else first


def frames_held(path: Path, view: str) -> FramesHeld:
    """Read once through a log, damaged or not, for the frames of a view that it holds."""
    first = stop = end = 0
    for channel, message in messages(path):
        if channel.topic == view_topic(view):
            if not end:
                first = stop = message.sequence
            if message.sequence == stop:
                stop += 1
            end = max(end, message.sequence + 1)
    return FramesHeld(first, stop, end)


@dataclass(frozen=True, slots=True)
class Resume:
    """Where a view is resumed; without arguments at its beginning.

    Attributes:
        parts: file and number of frames of each part that is finished, before the one to resume.
        first: first frame of the part to resume.
        log: the earlier log that holds the most frames of that part, where one does.
        stop: it holds [first, stop).
        complete: that log is the finished view, which stays as it is.
        stale: logs of which nothing is needed.
    """

    parts: tuple[tuple[Path, int], ...] = ()
    first: int = 0
    log: Path | None = None
    stop: int = 0
    complete: bool = False
    stale: tuple[Path, ...] = ()


def resume_view(
    folder: Path,
    view: str,
    identity: Identity,
    split: Split | None,
    there: Mapping[Path, FramesHeld],
    frames: int,
) -> Resume:
    """Pass over the parts that are finished, and find where to resume. Changes nothing.

    Args:
        folder: of the recording.
        view: name of the view.
        identity: what is recorded.
        split: where its parts end.
        there: all of the view's files, and what they hold.
        frames: how many the view shall have; no file has more.

    Raises:
        UsageError: what is there is something else, or split in another way.
    """
    length = split.frames(identity.spec.fps) if split else None
    other = next((path for path in there if (path.name in _names(view)) != (split is None)), None)
    if other is not None:
        raise UsageError(
            f"{other} was recorded {'with' if split is None else 'without'} --split: "
            "use the same, or overwrite with --force"
        )
    parts: list[tuple[Path, int]] = []
    first = 0
    while True:
        path = folder / part_name(view, None if split is None else len(parts))
        found = {p: there[p].whole(first) for p in _attempts(path) if p in there}
        later = [p for p in there if split is not None and part_number(p) > len(parts)]
        best = max(found, key=lambda p: found[p], default=None)
        if best is None or found[best] <= first:
            if path in found:
                raise UsageError(
                    f"{path} holds no frames of {view} from {first} on: overwrite with --force"
                )
            place = Resume(tuple(parts), first, stale=(*found, *later))
            break
        stop = found[best]
        _refuse_other(best, identity.facts(view, first))
        follows = best == path and bool(later)
        if length is not None and (stop - first > length or (follows and stop - first != length)):
            raise UsageError(
                f"{best} has {stop - first} frames, with this --split it would have {length}: "
                "use the same, or overwrite with --force"
            )
        if not follows:
            complete = best == path and stop == frames
            place = Resume(tuple(parts), first, best, stop, complete, tuple(later))
            break
        if stop >= frames:
            raise UsageError(
                f"{path} ends at frame {stop}, and more follow: ask for more frames, "
                "or overwrite with --force"
            )
        parts.append((path, stop - first))
        first = stop
    finished = next((p for p in later if p.suffix == ".mcap"), None)
    if finished is not None:
        raise UsageError(
            f"{finished} is there, {path.name} before it is not whole: recover that "
            "part first, or overwrite with --force"
        )
    return place


def keep(path: Path, log: Path) -> Path:
    """Move the log to be resumed aside, and remove the poorer ones of the same file.

    Returns:
        Where it is now.
    """
    kept = kept_path(path)
    if log != kept:
        os.replace(log, kept)
    for other in (path, partial_path(path)):
        other.unlink(missing_ok=True)
    return kept


def kept_path(path: Path) -> Path:
    """Where a partial is kept while its frames are copied into the new one."""
    return path.with_name(path.name + ".partial.kept")


def messages(path: Path) -> Iterator[tuple[Channel, Message]]:
    """Messages in the order of the file, up to where it is damaged or torn."""
    try:
        with path.open("rb") as file:
            reader = NonSeekingReader(file, validate_crcs=True, record_size_limit=_RECORD_LIMIT)
            for _, channel, message in reader.iter_messages(log_time_order=False):
                yield channel, message
    except _DAMAGE:
        return


def _attempts(path: Path) -> tuple[Path, Path, Path]:
    """Where earlier attempts at a log may have left frames."""
    return path, partial_path(path), kept_path(path)


def _names(view: str) -> set[str]:
    """Names that the logs of a view have that is not split."""
    return {path.name for path in _attempts(Path(part_name(view, None)))}


def _refuse_other(path: Path, facts: ViewFacts) -> None:
    """Refuse to resume a log of something else.

    Raises:
        UsageError: it states other facts.
    """
    try:
        with path.open("rb") as file:
            reader = NonSeekingReader(file, validate_crcs=True, record_size_limit=_RECORD_LIMIT)
            record = next((m for m in reader.iter_metadata() if m.name == METADATA), None)
    except _DAMAGE:
        record = None
    if record is None:
        raise UsageError(f"{path} does not say what it is a recording of: overwrite with --force")
    for key, value in facts.as_metadata().items():
        if record.metadata.get(key) != value:
            raise UsageError(
                f"{path} cannot be continued: its {key} is {record.metadata.get(key)!r}, now it is "
                f"{value!r}; use the same command and versions, or overwrite with --force"
            )
