"""Camera logs that were written in parts, read as one stream in the order of time."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any, Final, TypeVar

import numpy as np

from cdmisfa.core.clock import NANOSECONDS, RECORDED_FPS
from cdmisfa.core.errors import LogDamagedError, UsageError
from recorder.images.options import Size
from recorder.images.pixels import MalformedImage, Shown
from recorder.mcap.records import MalformedRecord
from replay.camera_logs.alignment import Times, even_times, step_of
from replay.camera_logs.formats.table import TableNumbers
from replay.camera_logs.stream import ImagesOf, ImageStream, sorted_times
from replay.storage.location import Location

Found = TypeVar("Found")

_COUNTED: Final = "say what its times count, as --time COLUMN:s (or ms, us, ns)"
"""What to do where the times of a table are of another unit."""


class JoinedImages(ImageStream):
    """The images on one topic of several logs, by their times, ties in the order of the logs."""

    def __init__(
        self, path: Location, parts: Sequence[ImageStream], warnings: Sequence[str] = ()
    ) -> None:
        self.path = path
        self.recipe, self.fields = parts[0].recipe, parts[0].fields
        self.topic = parts[0].topic
        joined = f"{path}: {self.topic} is joined from {len(parts)} logs, by time"
        self.warnings = [joined, *warnings] if len(parts) > 1 else [*warnings]
        self.warnings += [warning for part in parts for warning in part.warnings]
        self.told_rounded = all(part.told_rounded for part in parts)
        self.decode = parts[0].decode
        self._streams = list(parts)
        times = np.concatenate([part.times for part in parts])
        order = np.argsort(times, kind="stable")
        self.times = times[order]
        self._part_of = np.repeat(np.arange(len(parts)), [part.count for part in parts])[order]
        self._row_in = np.concatenate([np.arange(part.count) for part in parts])[order]

    @property
    def parts(self) -> Sequence[ImageStream]:
        return [log for part in self._streams for log in part.parts]

    def image(self, row: int) -> Shown:
        return self._streams[int(self._part_of[row])].image(int(self._row_in[row]))

    def taken(self, row: int, take: Callable[[Any], Found]) -> Found:
        """What is taken of a message, where the logs are of messages."""
        part: Any = self._streams[int(self._part_of[row])]
        found: Found = part.taken(int(self._row_in[row]), take)
        return found

    def stamp(self, row: int) -> int:
        return self._streams[int(self._part_of[row])].stamp(int(self._row_in[row]))

    def distances(self) -> bool:
        return any(part.distances() for part in self._streams)

    def stated_size(self, row: int) -> Size | None:
        return self._streams[int(self._part_of[row])].stated_size(int(self._row_in[row]))

    def where(self, row: int) -> str:
        return self._streams[int(self._part_of[row])].where(int(self._row_in[row]))

    def close(self) -> None:
        for part in self._streams:
            part.close()


class Stamped(ImagesOf):
    """The images of a stream in the order and at the times that their messages say.

    Every message is read for it.

    Raises:
        UsageError: they say nothing.
        LogDamagedError: a message cannot be read.
    """

    def __init__(self, images: ImageStream) -> None:
        stamps = np.empty(images.count, np.int64)
        for row in range(images.count):
            try:
                stamps[row] = images.stamp(row)
            except (MalformedRecord, MalformedImage) as error:
                raise LogDamagedError(f"{images.where(row)}: {error}") from None
        if len(stamps) > 1 and stamps.min() == stamps.max():
            raise UsageError(
                f"{images.path}: the headers on {images.topic} all say {stamps[0]} ns: leave out "
                "--stamp header"
            )
        self._order = np.argsort(stamps, kind="stable")
        times = sorted_times(f"{images.path}: {images.topic}", stamps[self._order])
        super().__init__(images, times)

    def _row(self, row: int) -> int:
        return int(self._order[row])


class ImagesBetween(ImagesOf):
    """The images [start, stop) of a stream."""

    def __init__(self, images: ImageStream, start: int, stop: int) -> None:
        super().__init__(images, images.times[start:stop])
        self._start, self._length = start, stop - start

    @property
    def count(self) -> int:
        return self._length

    def _row(self, row: int) -> int:
        return self._start + row


def known_times(streams: Sequence[ImageStream], fps: float) -> list[Times]:
    """When each stream's images were taken; where nobody knows, at an even rate."""
    return [s.times if len(s.times) else even_times(s.count, fps) for s in streams]


def excerpts(
    streams: Sequence[ImageStream], times: Sequence[Times], start: float, stop: float | None
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
                "choose another --from or --to"
            )
        found.append(ImagesBetween(images, low, high))
    return found


def join_parts(streams: Sequence[ImageStream]) -> list[ImageStream]:
    """Join logs with one topic of which each begins after another ends; others stay streams."""
    found: list[ImageStream] = []
    for topic in dict.fromkeys(stream.topic for stream in streams):
        found += _joined([stream for stream in streams if stream.topic == topic])
    return found if len(found) < len(streams) else list(streams)


def _joined(streams: Sequence[ImageStream]) -> list[ImageStream]:
    ordered = sorted(streams, key=lambda s: int(s.times[0]) if len(s.times) else 0)
    follow = all(
        len(one.times) and len(two.times) and int(one.times[-1]) < int(two.times[0])
        for one, two in itertools.pairwise(ordered)
    )
    if len(streams) < 2 or not follow:
        return list(streams)
    return [JoinedImages(ordered[0].path, ordered)]


def rate_of(streams: Sequence[ImageStream]) -> float:
    """Images a second of the first stream that has times.

    Raises:
        UsageError: none has, or they tell no rate that is taken.
    """
    timed = next((s for s in streams if len(s.times)), streams[0])
    step = step_of(timed.times)
    table = isinstance(timed, TableNumbers)
    if not step > 0:
        what = f"{timed.path}: {timed.topic}" if len(timed.times) else timed.path
        remedy = ", or name the column of its times with --time" if table else ""
        if table and len(timed.times):
            what = f"{timed.path}: most of its rows are of the time of the row before, which"
            remedy = f", or {_COUNTED}"
        raise UsageError(f"{what} tells no rate: set one with --rate{remedy}")
    if table and 1 / step > RECORDED_FPS[1]:
        raise UsageError(
            f"{timed.path}: {1 / step:.6g} rows a second are more than the {RECORDED_FPS[1]:.0f} "
            f"that are taken: {_COUNTED}, or set a rate with --rate"
        )
    return float(f"{1 / step:.6g}")
