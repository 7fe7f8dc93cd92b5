"""Streams made of others, joined, cut, in order, broken images replaced; and copies of others."""

from __future__ import annotations

import hashlib
import itertools
import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import ByteArray, IntArray
from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.names import stream_name, stream_names
from recorder.images.options import VIDEO_RECIPE
from recorder.images.pixels import DISTANCES, MalformedImage, Shown
from recorder.images.videos import VideoPackets
from recorder.mcap.records import MalformedRecord
from replay.camera_logs.stream import ImageStream, UnreadableError, sorted_times

Found = TypeVar("Found")

BROKEN = (MalformedImage, MalformedRecord, UnreadableError)
"""What is raised of one image, behind which there may be whole ones."""

SALVAGE: Final = "learn and convert pass over what is broken with --salvage"
"""What to do about it."""

_COMPARED: Final = 9
"""Images of two streams that are compared, from the first to the last."""

_NUMBERS: Final = 256
"""As many where they are numbers, of which few can be the same by chance."""


class Selected(ImageStream):
    """Images of other streams, which are closed with this one.

    Args:
        streams: the others, of one topic; what is known of the first is taken to hold for all.
        of: (n,) which of the streams each image is of.
        rows: (n,) its row there.
        times: (n,) when it was taken, nanoseconds; empty where that is not known.
    """

    def __init__(
        self,
        streams: Sequence[ImageStream],
        of: NDArray[Any],
        rows: NDArray[Any],
        times: NDArray[np.uint64],
    ) -> None:
        first = streams[0]
        self.path, self.topic, self.encoding = first.path, first.topic, first.encoding
        self.recipe, self.fields, self.decode = first.recipe, first.fields, first.decode
        self.warnings = [warning for stream in streams for warning in stream.warnings]
        self.told_rounded = all(stream.told_rounded for stream in streams)
        self.times = times
        self._streams, self._of, self._rows = streams, of, rows

    @property
    def count(self) -> int:
        return len(self._rows)

    @property
    def logs(self) -> Sequence[ImageStream]:
        return [log for stream in self._streams for log in stream.logs]

    def _at(self, row: int) -> tuple[ImageStream, int]:
        return self._streams[int(self._of[row])], int(self._rows[row])

    def image(self, row: int) -> Shown:
        stream, own = self._at(row)
        return stream.image(own)

    def begin(self, row: int, threads: Executor) -> Future[ByteArray] | None:
        stream, own = self._at(row)
        return stream.begin(own, threads)

    def taken(self, row: int, take: Callable[[Any], Found]) -> Found:
        stream, own = self._at(row)
        return stream.taken(own, take)

    def stamp(self, row: int) -> int:
        stream, own = self._at(row)
        return stream.stamp(own)

    def where(self, row: int) -> str:
        stream, own = self._at(row)
        return stream.where(own)

    def pixels(self) -> str | None:
        stated = [stream.pixels() for stream in self._streams]
        return next((one for one in stated if one in DISTANCES), stated[0])

    def close(self) -> None:
        for stream in self._streams:
            stream.close()


def selected(stream: ImageStream, rows: IntArray, times: NDArray[np.uint64]) -> Selected:
    """Some rows of a stream, with their times."""
    return Selected([stream], np.zeros(len(rows), np.int32), rows, times)


def join_by_time(
    path: Path, streams: Sequence[ImageStream], warnings: Sequence[str] = ()
) -> ImageStream:
    """The images on one topic of several logs, by their times, ties in the order of the logs."""
    times = np.concatenate([stream.times for stream in streams])
    order = np.argsort(times, kind="stable")
    of = np.repeat(np.arange(len(streams)), [stream.count for stream in streams])
    rows = np.concatenate([np.arange(stream.count) for stream in streams])
    found = Selected(streams, of[order], rows[order], times[order])
    found.path = path
    said = [*warnings]
    if len(streams) > 1:
        said = [f"{path}: {found.topic} is joined from {len(streams)} logs, by time", *said]
    found.warnings = [*said, *found.warnings]
    return found


def join_parts(streams: Sequence[ImageStream]) -> list[ImageStream]:
    """Join logs with one topic of which each begins after another ends; others stay streams."""
    found: list[ImageStream] = []
    for topic in dict.fromkeys(stream.topic for stream in streams):
        own = [stream for stream in streams if stream.topic == topic]
        ordered = sorted(own, key=lambda s: int(s.times[0]) if len(s.times) else 0)
        follow = len(own) > 1 and all(
            len(one.times) and len(two.times) and int(one.times[-1]) < int(two.times[0])
            for one, two in itertools.pairwise(ordered)
        )
        found += [join_by_time(ordered[0].path, ordered)] if follow else own
    return found if len(found) < len(streams) else list(streams)


def by_stamps(images: ImageStream) -> ImageStream:
    """The images of a stream in the order and at the times that their messages state.

    Every message is read for it.

    Raises:
        UsageError: they state none.
        LogDamagedError: a message cannot be read.
    """
    stamps = np.empty(images.count, np.int64)
    for row in range(images.count):
        try:
            stamps[row] = images.stamp(row)
        except (MalformedRecord, MalformedImage) as error:
            raise LogDamagedError(f"{images.where(row)}: {error}") from None
    if len(stamps) > 1 and stamps.min() == stamps.max():
        raise UsageError(
            f"{images.path}: the headers on {images.topic} all say {stamps[0]} ns: leave out "
            "--set input.stamp=header"
        )
    order = np.argsort(stamps, kind="stable")
    times = sorted_times(f"{images.path}: {images.topic}", stamps[order])
    return selected(images, order, times)


def excerpts(
    streams: Sequence[ImageStream],
    times: Sequence[NDArray[np.uint64]],
    start: float,
    stop: float | None,
) -> list[ImageStream]:
    """What streams show from one moment to another, in seconds after the first image of all.

    Args:
        streams: the streams.
        times: of their images, (n,) nanoseconds each.
        start: of the first images.
        stop: no image is so late; None for all.

    Raises:
        UsageError: a stream has no image there.
    """
    zero = min(int(t[0]) for t in times)
    ends = [None if s is None else zero + round(s * NANOSECONDS) for s in (start, stop)]
    found: list[ImageStream] = []
    for images, own in zip(streams, times, strict=True):
        low, high = (len(own) if e is None else int(np.searchsorted(own, e)) for e in ends)
        if low >= high:
            lasts = (int(own[-1]) - zero) / NANOSECONDS
            raise UsageError(
                f"{images.path}: {images.topic} has no images there, its last is at {lasts:g} s: "
                "choose another --start or --end"
            )
        found.append(selected(images, np.arange(low, high), images.times[low:high]))
    return found


class VideoMessages(Selected):
    """The pictures of a video in a log's messages, in any order.

    They are those from the first on that needs none before it.

    Args:
        messages: the log's.
        packets: their decoder.

    Raises:
        UsageError: no picture needs none before it.
        LogDamagedError: the log is damaged.
    """

    def __init__(self, messages: ImageStream, packets: VideoPackets) -> None:
        self._messages, self._packets = messages, packets
        self._next = -1
        self._broken: dict[int, MalformedImage | MalformedRecord] = {}
        rows = np.arange(messages.count)
        first = next((row for row in range(len(rows)) if self._begins(row)), len(rows))
        if first == len(rows):
            raise UsageError(f"{messages.path}: {messages.topic}: {self._why()}")
        super().__init__(
            [messages], np.zeros(len(rows) - first, np.int32), rows[first:], messages.times[first:]
        )
        self._first = first
        self.recipe = VIDEO_RECIPE
        if first:
            lost = f"{self.path}: {first} pictures that need earlier ones are left out"
            self.warnings = [*self.warnings, lost]

    def image(self, row: int) -> Shown:
        row += self._first
        start = row
        while start not in (self._first, self._next) and not self._begins(start):
            start -= 1
            if start in self._broken:  # of which those behind it are made
                raise self._broken[start]
        if start != self._next:
            self._packets.forget()
        self._next = -1
        for at in range(start, row + 1):
            try:
                shown = self._messages.taken(at, self._packets)
            except (MalformedImage, MalformedRecord) as error:
                self._broken[at] = error
                raise
        self._next = row + 1
        return shown

    def pixels(self) -> str:
        return ""  # known without a message, which may be broken

    def _begins(self, row: int) -> bool:
        try:
            return self._messages.taken(row, self._packets.begins)
        except (MalformedImage, MalformedRecord):
            return False

    def _why(self) -> str:
        """Why nothing of the video can be decoded."""
        try:
            self._messages.taken(0, self._packets.begins)
        except (MalformedImage, MalformedRecord) as error:
            return str(error)
        return "each picture of its video needs earlier ones"


class WholeImages(Selected):
    """A stream's images, for a broken one the last whole one before it, else the first of all.

    Which one that is depends on the log alone, not on what was asked for before.

    Attributes:
        broken: the rows of the broken images that were met, each with what is wrong with it.
    """

    def __init__(self, images: ImageStream) -> None:
        rows = np.arange(images.count)
        super().__init__([images], np.zeros(len(rows), np.int32), rows, images.times)
        self.broken: dict[int, LogDamagedError] = {}
        self._last: tuple[int, Shown] | None = None

    def image(self, row: int) -> Shown:
        """Decode an image, or that which stands for it; raises what is wrong if none is whole."""
        for near in itertools.chain(range(row, -1, -1), range(row + 1, self.count)):
            if near in self.broken:
                continue
            if self._last is not None and self._last[0] == near:
                return self._last[1]
            try:
                self._last = near, super().image(near)
                return self._last[1]
            except BROKEN as error:
                self.broken[near] = error
        raise self.broken[row]

    def pixels(self) -> str | None:
        try:
            return super().pixels()
        except BROKEN:
            return None  # the image that would tell is broken

    def said(self) -> str | None:
        """A line that counts the broken images met so far; None if there were none."""
        if not self.broken:
            return None
        first = min(self.broken)
        what = "messages" if self.fields else "images"
        return (
            f"{self.where(first)}: {self.broken[first]}: {len(self.broken)} broken of {self.count} "
            f"{what}: the last whole one is taken instead"
        )


def names_of(streams: Sequence[ImageStream]) -> tuple[str, ...]:
    """Names of streams by their topics, with the file's and folders' where topics are shared.

    Raises:
        UsageError: a topic of a log is named twice.
    """
    topics = [s.topic for s in streams]
    if len(set(topics)) == len(topics):
        return stream_names(topics)
    paths = [str(s.path.resolve()) for s in streams]
    places = list(zip(paths, topics, strict=True))
    for i, place in enumerate(places):
        if place in places[:i]:
            raise UsageError(f"{topics[i]} of {streams[i].path} is named twice: leave one out")
    for folders in range(max(len(Path(path).parts) for path in paths)):
        names = [_in_folders(stream, folders) for stream in streams]
        if len(set(names)) == len(names):
            return stream_names(names)
    return stream_names([f"{i + 1}/{topic}" for i, topic in enumerate(topics)])


def _in_folders(stream: ImageStream, folders: int) -> str:
    """A stream's name with those of its file, and of some of the folders this is in."""
    path, own = stream.path, stream_name(stream.topic)
    stems = [path.stem, path.resolve().name]
    if own not in map(stream_name, stems):
        own = f"{path.stem}/{own}"
    above = Path(os.path.abspath(path)).parts[:-1]
    return "/".join([*above[max(len(above) - folders, 0) :], own])


def copies(streams: Sequence[ImageStream]) -> Iterator[str]:
    """A line for each stream that shows the same as one before it, of another log.

    Their times are the same, and some of their images.
    """
    counts = Counter(stream.count for stream in streams)
    known: dict[tuple[int, bytes], list[ImageStream]] = {}
    for stream in streams:
        if counts[stream.count] < 2 or (first := _shown(stream, 0)) is None:
            continue
        alike = known.setdefault((stream.count, first), [])
        other = next((other for other in alike if _same(other, stream)), None)
        if other is None:
            alike.append(stream)
        else:
            yield (
                f"{stream.path}: {stream.topic} shows the same as {other.topic} of {other.path}, "
                "as a copy does"
            )


def _same(one: ImageStream, two: ImageStream) -> bool:
    if one.path == two.path or not np.array_equal(one.times, two.times):
        return False
    most = _NUMBERS if one.fields else _COMPARED
    rows = np.unique(np.linspace(0, one.count - 1, most).astype(int)).tolist()
    pairs = ((_shown(one, row), _shown(two, row)) for row in rows)
    return all(first is not None and first == second for first, second in pairs)


def _shown(stream: ImageStream, row: int) -> bytes | None:
    """What identifies an image, None of one that cannot be read."""
    try:
        image = stream.image(row)
    except (*BROKEN, LogDamagedError, UsageError):
        return None
    return hashlib.sha256(repr(image.shape).encode() + image.tobytes()).digest()
