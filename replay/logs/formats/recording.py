"""Our own recordings: frames and ground truth of a view, addressed by the numbers of frames.

A block is copied out of its chunks by the kernel `gather`, without a Python object for each frame.
"""

from __future__ import annotations

import bisect
import functools
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap.records import Channel
from numpy.typing import NDArray

from cdmisfa.core.arrays import ByteArray, FloatArray
from cdmisfa.core.errors import LogDamagedError
from cdmisfa.kernels.frames import gather
from cdmisfa.kernels.frames import layout as kernel_layout
from recorder.log.manifest import ViewMetadata
from recorder.log.messages import (
    IMAGE_ENCODING,
    IMAGE_SCHEMA,
    RECORDING_METADATA,
    TRUTH_SCHEMA,
    TRUTH_TOPIC,
    VECTOR_SCHEMA,
    image_payload,
    truth_tags,
    vector_payload,
    view_topic,
)
from recorder.mcap.chunks import MessageTable
from recorder.mcap.reader import LogReader
from recorder.mcap.records import Segment
from replay.logs.clock import intersection
from replay.logs.health import Health
from replay.logs.stream import explained
from replay.stored_source import Span


class NoRecordingError(LogDamagedError):
    """A log that is no recording of ours; it may be whole, and somebody else's."""


class ViewFile:
    """Frames and ground truth of one file of a recording.

    Attributes:
        path: the file.
        facts: metadata of the file.
        ranges: the frames that are there with their ground truth, each [start, stop); one range,
            except with `skip_damaged`, and of live streams with gaps.
    """

    def __init__(
        self, path: Path, *, skip_damaged: bool = False, reader: LogReader | None = None
    ) -> None:
        """Open one view's file and check the times of its frames.

        Args:
            path: the file.
            skip_damaged: skip damaged parts.
            reader: reader of the file, which the caller closes; then no frame is known until
                `check_chunk` was called with each chunk, and `finish`.

        Raises:
            NoRecordingError: it is no view of a recording.
            LogDamagedError: the file is damaged.
        """
        self.path, by_chunk = path, reader is not None
        self.ranges: list[Span] = []
        self.reader = reader or LogReader(path, skip_damaged=skip_damaged)
        try:
            records = [m for m in self.reader.metadata if m.name == RECORDING_METADATA]
            if len(records) != 1:
                raise NoRecordingError(f"{path}: not a recording of cdmisfa")
            self.facts = facts = ViewMetadata.parse(path, records[0].metadata)
            schema = IMAGE_SCHEMA if facts.spec.images else VECTOR_SCHEMA
            self._channels = [self._channel("a frame", view_topic(facts.view), schema)]
            if facts.truth:
                self._channels.append(self._channel("ground truth", TRUTH_TOPIC, TRUTH_SCHEMA))
            if not by_chunk:
                self.reader.expect(self.reader.segments)
                for rows in self._channels:
                    rows.extend()
                self.finish()
                if self.ranges:
                    self._find_layouts()
        except BaseException:
            if not by_chunk:
                self.reader.close()
            raise

    @property
    def count(self) -> int:
        """Number of frames that are there."""
        return sum(stop - start for start, stop in self.ranges)

    def take(self, start: int, frames: NDArray[Any], truth: FloatArray) -> None:
        """Fill in the frames from `start` on, all in one of `ranges`, and their ground truth.

        Args:
            start: the first frame.
            frames: (n, *frame_shape), written.
            truth: (n, D), written.

        Raises:
            LogDamagedError: a chunk or a message in it is damaged.
        """
        outs = [frames.reshape(len(frames), -1).view(np.uint8), truth.view(np.uint8)]
        pieces = []
        for which, rows in enumerate(self._channels):
            at = 0
            for number, low, n in rows.pieces(start, len(frames)):
                pieces.append((rows.segments[number].offset, which, number, low, at, at + n))
                at += n
        for _, which, number, low, at, stop in sorted(pieces):  # each chunk is decoded once
            self._channels[which].read(number, low, stop - at, outs[which][at:stop])

    def check_chunk(self, segment: Segment, health: Health) -> None:
        """Check every frame of the next chunk of the file, and measure its images.

        Raises:
            LogDamagedError: a time is no frame's, or a message is laid out unlike the others.
        """
        for rows in self._channels:
            rows.add(segment)
        self._find_layouts()
        for rows in self._channels:
            in_chunk = rows.segments and rows.segments[-1] is segment
            if in_chunk and rows.layout is not None and self.reader.table(segment) is not None:
                number, count = len(rows.segments) - 1, rows.starts[-1] - rows.starts[-2]
                images = self.facts.spec.images and rows is self._channels[0]
                frames = np.empty((count, rows.width), np.uint8) if images else None
                rows.read(number, 0, count, frames)
                if frames is not None:
                    for time, frame in zip(rows.times(number).tolist(), frames, strict=True):
                        shaped = functools.partial(frame.reshape, self.facts.frame_shape)
                        health.add(time / 1e9, shaped)

    def finish(self) -> None:
        """Set `ranges`, after the last chunk."""
        covered: list[list[Span]] = [
            [(one.start, one.stop) for one in rows.ranges] for rows in self._channels
        ]
        self.ranges = covered[0] if len(covered) == 1 else intersection(*covered)

    def close(self) -> None:
        """Close the file."""
        self.reader.close()

    def _channel(self, what: str, topic: str, schema: str) -> _ChannelRows:
        channels = [c for c in self.reader.channels.values() if c.topic == topic]
        if not channels and self.reader.missing:
            raise LogDamagedError(f"{self.path}: {self.reader.missing}, before the first message")
        known = [self.reader.schemas.get(c.schema_id) for c in channels]
        protobuf = [c.message_encoding == "protobuf" for c in channels]
        if protobuf != [True] or known[0] is None or known[0].name != schema:
            raise LogDamagedError(
                f"{self.path}: {topic} must be one protobuf channel of {schema}, and is not"
            )
        return _ChannelRows(what, self.reader, channels[0], self.facts)

    def _find_layouts(self) -> None:
        """Find out where messages hold their values, from the first frame."""
        frames, facts = self._channels[0], self.facts
        if frames.layout is not None or not frames.ranges:
            return
        if facts.spec.images:
            with explained(self.path, "protobuf"):
                image = RawImage.FromString(frames.payload(frames.ranges[0].start))
            stated = image.height, image.width, image.step, image.encoding
            if stated != (*facts.frame_shape, facts.frame_shape[1], IMAGE_ENCODING):
                raise LogDamagedError(
                    f"{self.path}: its frames differ from its metadata in size or encoding"
                )
            payload = image_payload(image.height, image.width, image.frame_id)
        else:
            frames.payload(frames.ranges[0].start)
            payload = vector_payload(facts.frame_shape[0])
        place = payload.tail + payload.size
        marks = {place + len(payload.before) - i: b for i, b in enumerate(payload.before)}
        frames.set_layout(place + len(payload.before), marks, [place], payload.size)
        if facts.truth:
            marks, places, at = {}, [], 0
            for tag in reversed(truth_tags(facts.truth)):  # a value of 8 bytes behind each
                places.append(at + 8)
                at += 8 + len(tag)
                marks |= {at - i: byte for i, byte in enumerate(tag)}
            self._channels[1].set_layout(at, marks, places[::-1], 8)


class _RowRange(NamedTuple):
    """The frames [start, stop), as the messages of a channel from `row` on."""

    start: int
    stop: int
    row: int


class _ChannelRows:
    """The messages of one channel, numbered through all chunks of a file by their log time.

    Attributes:
        ranges: the frames that are there; one range, but where gaps and damage are left out.
        segments: the chunks that hold messages of the channel.
        starts: the number of the first message of each, and how many there are.
        layout: where the messages hold their values, once a message is known.
    """

    def __init__(self, what: str, reader: LogReader, channel: Channel, facts: ViewMetadata) -> None:
        self.ranges: list[_RowRange] = []
        self.segments: list[Segment] = []
        self.starts = [0]
        self.layout: Any = None
        self._what, self.places, self.width = what, list[int](), 0
        self._reader, self._channel, self._facts = reader, channel, facts
        self._may_lack = reader.skip_damaged or facts.gaps
        self._trusted, self._confirmed = False, set[int]()

    def set_layout(self, least: int, marks: dict[int, int], places: list[int], width: int) -> None:
        """Set where a message holds its values, counted from its end.

        Args:
            least: fewest bytes of a message.
            marks: by distance bytes that are the same in every message.
            places: (R,) distance of each value.
            width: bytes of a value.
        """
        self.places, self.width = places, width
        self.layout = kernel_layout(least, list(marks), list(marks.values()), places, width)

    def extend(self) -> None:
        """Number the messages of the whole file.

        Raises:
            LogDamagedError: a log time that is no frame's, a frame twice or out of order, and
                without `skip_damaged` a missing frame, unless the file says that it has gaps.
        """
        self._trusted = self._reader.by_index and not self._may_lack
        for segment in self._reader.segments:
            if self._trusted:  # its log times are compared with the counts when it is read
                self._count_messages(segment)
            else:
                self.add(segment)
        if self._trusted and (count := self.starts[-1]):
            first = self._facts.first_frame
            self.ranges = [_RowRange(first, first + count, 0)]

    def add(self, segment: Segment) -> None:
        """Number the messages of the next chunk; raises as `extend`."""
        if self._count_messages(segment):
            number = len(self.segments) - 1
            if not (self._reader.skip_damaged and self._reader.table(segment) is None):
                self._number(self.times(number), self.starts[number], self.ranges)

    def payload(self, frame: int) -> bytes:
        """Return the message of a frame."""
        number, low, _ = next(self.pieces(frame, 1))
        table = self._table(number)
        return table.payload(int(np.flatnonzero(table.channel == self._channel.id)[low]))

    def pieces(self, frame: int, count: int) -> Iterator[tuple[int, int, int]]:
        """Yield where the messages of `count` frames of one range are, from a frame on.

        Yields:
            For each chunk its number in `segments`, its first message, and how many.
        """
        at = bisect.bisect_right(self.ranges, frame, key=lambda one: one.start) - 1
        row = self.ranges[at].row + frame - self.ranges[at].start
        stop, number = row + count, bisect.bisect_right(self.starts, row) - 1
        while row < stop:
            start, end = self.starts[number], min(self.starts[number + 1], stop)
            yield number, row - start, end - row
            row, number = end, number + 1

    def read(self, number: int, low: int, n: int, out: ByteArray | None) -> None:
        """Check how messages of a chunk are laid out, and copy their values.

        Args:
            number: index of the chunk in `segments`.
            low: the first message.
            n: how many.
            out: (n, bytes of a message's values), written; None to check only.

        Raises:
            LogDamagedError: the chunk is damaged, or one is laid out otherwise than others.
        """
        table, channel, rows = self._table(number), self._channel.id, (low, low + n)
        if gather(table.data, table.records, channel, rows, self.layout, out) is None:
            where = f"{self._reader.path}: {self.segments[number].name}"
            raise LogDamagedError(f"{where}: {self._what} has another layout than the others")

    def _count_messages(self, segment: Segment) -> bool:
        """Count the channel's messages in the next chunk of the file; whether it has any."""
        counts = segment.channel_counts()
        if counts is None:
            table = self._reader.table(segment)
            count = 0 if table is None else int((table.channel == self._channel.id).sum())
        else:
            count = counts.get(self._channel.id, 0)
        if count:
            self.segments.append(segment)
            self.starts.append(self.starts[-1] + count)
        return count > 0

    def _number(self, times: NDArray[np.uint64], row: int, ranges: list[_RowRange]) -> None:
        """Add the frames of messages from `row` on to the ranges found."""
        frames = self._facts.frames_at(times)
        exact = self._facts.times(frames) == times
        before = ranges[-1].stop if ranges else self._facts.first_frame
        steps = np.diff(frames, prepend=before - 1)
        wrong = np.flatnonzero(~exact | (steps < 1 if self._may_lack else steps != 1))
        if len(wrong):
            at = int(wrong[0])
            raise LogDamagedError(
                f"{self._reader.path}: {self._channel.topic}: frame "
                f"{int(frames[at]) - int(steps[at])} is followed by log time {times[at]} ns, frame "
                f"{frames[at]}: frames are missing or duplicated; run cdmisfa recover"
            )
        edges = [0, *(np.flatnonzero(steps[1:] != 1) + 1).tolist(), len(frames)]
        for low, high in itertools.pairwise(edges):
            start, count = int(frames[low]), high - low
            last = ranges[-1] if ranges else None
            if last and last.stop == start and last.row + start - last.start == row + low:
                ranges[-1] = last._replace(stop=start + count)
            else:
                ranges.append(_RowRange(start, start + count, row + low))

    def times(self, number: int) -> NDArray[np.uint64]:
        """Return the log times (ns) of the channel's messages in a chunk."""
        segment, channel = self.segments[number], self._channel.id
        if not segment.indexes:
            table = self._table(number)
            times: NDArray[np.uint64] = table.log_time[table.channel == channel]
            return times
        return np.concatenate([p[:, 0] for _, p in self._reader.index(segment, (channel,))])

    def _table(self, number: int) -> MessageTable:
        """Return a chunk's messages; a LogDamagedError if it is damaged or has other frames."""
        segment, path = self.segments[number], self._reader.path
        table = self._reader.table(segment)
        if table is None:
            raise LogDamagedError(f"{path}: {segment.name} is damaged")
        if number in self._confirmed:
            return table
        times = table.log_time[table.channel == self._channel.id]
        (row, stop), first = self.starts[number : number + 2], self._facts.first_frame
        if len(times) != stop - row:
            raise LogDamagedError(
                f"{path}: {segment.name} has {len(times)} messages of {self._channel.topic!r}, but "
                f"its index states {stop - row}; run cdmisfa recover"
            )
        expected = self._facts.times(np.arange(first + row, first + stop))
        if self._trusted and (times != expected).any():  # raises an error that names the frame
            self._number(times, row, [_RowRange(first, first + row, 0)] if row else [])
        self._confirmed.add(number)
        return table
