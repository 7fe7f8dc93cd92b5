"""One file of a recording: the frames of one view, addressed by their number."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from cdmisfa.core.errors import LogDamagedError
from recorder.log.manifest import ViewMetadata
from recorder.log.messages import (
    IMAGE_ENCODING,
    IMAGE_SCHEMA,
    RECORDING_METADATA,
    TRUTH_SCHEMA,
    TRUTH_TOPIC,
    VECTOR_SCHEMA,
    Payload,
    image_payload,
    truth_tags,
    vector_payload,
    view_topic,
)
from recorder.mcap.reader import LogReader
from recorder.mcap.records import Segment
from replay.recordings.rows import ChannelRows, RowLayout


class NoRecordingError(LogDamagedError):
    """A log that is no recording of ours; it may be whole, and somebody else's."""


class ViewFile:
    """Frames and ground truth of one file, without a Python object a frame.

    Attributes:
        path: the file.
        facts: what it states about itself.
        ranges: the frames that are there with their ground truth, each [start, stop); one range,
            except with `salvage`, and of live streams with gaps.
    """

    def __init__(
        self,
        path: Path,
        *,
        salvage: bool = False,
        reader: LogReader | None = None,
    ) -> None:
        """Open one view's file and check the times of its frames.

        Args:
            path: the file.
            salvage: leave out what is damaged.
            reader: of the file, which the caller closes; then no frame is known until
                `check_chunk` was called with each chunk, and `finish`.

        Raises:
            LogDamagedError: it is damaged, or no view of a recording.
        """
        self.path = path
        self._by_chunk = reader is not None
        self.reader = reader or LogReader(path, salvage=salvage)
        try:
            self._open()
        except BaseException:
            if reader is None:
                self.reader.close()
            raise

    def _open(self) -> None:
        records = [m for m in self.reader.metadata if m.name == RECORDING_METADATA]
        if len(records) != 1:
            raise NoRecordingError(
                f"{self.path}: no recording of cdmisfa "
                f"({len(records)} {RECORDING_METADATA} records); "
                "cdmisfa learn and convert take logs of others, by their --topic"
            )
        self.facts = facts = ViewMetadata.parse(self.path, records[0].metadata)
        self.reader.expect(self.reader.segments)
        schema = IMAGE_SCHEMA if facts.spec.images else VECTOR_SCHEMA
        self._channels = [self._channel(view_topic(facts.view), schema)]
        if facts.truth:
            self._channels.append(self._channel(TRUTH_TOPIC, TRUTH_SCHEMA))
        self.ranges: list[tuple[int, int]] = []
        if not self._by_chunk:
            for rows in self._channels:
                rows.extend()
            self._find_ranges()
            if self.ranges:
                self._find_layouts()

    def _find_ranges(self) -> None:
        self.ranges = functools.reduce(intersection, (rows.ranges for rows in self._channels))

    @property
    def count(self) -> int:
        """Frames that are there."""
        return sum(stop - start for start, stop in self.ranges)

    def take(self, start: int, frames: NDArray[Any], truth: NDArray[np.float64]) -> None:
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
                pieces.append((rows.place(number), which, number, low, at, at + n))
                at += n
        for _, which, number, low, at, stop in sorted(pieces):  # each chunk is decoded once
            self._channels[which].read(number, low, stop - at, outs[which][at:stop])

    def check_chunk(self, segment: Segment) -> None:
        """Check every frame of the next chunk of the file, without copying any.

        Raises:
            LogDamagedError: a time is no frame's, or a message is laid out unlike the others.
        """
        for rows in self._channels:
            rows.add(segment)
        self._find_layouts()
        for rows in self._channels:
            rows.check_last(segment)

    def finish(self) -> None:
        """Set `ranges`, after the last chunk was checked."""
        self._find_ranges()

    def close(self) -> None:
        """Close the file."""
        self.reader.close()

    def _find_layouts(self) -> None:
        """Determine where messages hold their values, from the first frame."""
        frames = self._channels[0]
        if frames.layout is not None or not frames.row_ranges:
            return
        payload = self._find_payload(frames.payload(frames.row_ranges[0].start))
        place = payload.tail + payload.size
        marks = {place + len(payload.before) - i: b for i, b in enumerate(payload.before)}
        least = place + len(payload.before)
        self._channels[0].layout = RowLayout("a frame", least, marks, [place], payload.size)
        if self.facts.truth:
            marks, values, at = {}, [], 0
            for tag in reversed(truth_tags(self.facts.truth)):  # a value of 8 bytes behind each
                values.append(at + 8)
                at += 8 + len(tag)
                marks |= {at - i: byte for i, byte in enumerate(tag)}
            self._channels[1].layout = RowLayout("ground truth", at, marks, values[::-1], 8)

    def _channel(self, topic: str, schema: str) -> ChannelRows:
        channels = [c for c in self.reader.channels.values() if c.topic == topic]
        if not channels and self.reader.missing:
            raise LogDamagedError(f"{self.path}: {self.reader.missing}: there is no message before")
        if len(channels) != 1:
            raise LogDamagedError(
                f"{self.path}: {len(channels)} channels on {topic}, a recording has one"
            )
        known = self.reader.schemas.get(channels[0].schema_id)
        if known is None or known.name != schema or channels[0].message_encoding != "protobuf":
            raise LogDamagedError(f"{self.path}: {topic} does not hold {schema} in protobuf")
        return ChannelRows(self.reader, channels[0], self.facts)

    def _find_payload(self, first: bytes) -> Payload:
        shape = self.facts.frame_shape
        if not self.facts.spec.images:
            return vector_payload(shape[0])
        try:
            image = RawImage.FromString(first)
        except DecodeError:
            raise LogDamagedError(f"{self.path}: its frames are no foxglove.RawImage") from None
        if (image.height, image.width) != shape or image.step != shape[1]:
            raise LogDamagedError(
                f"{self.path}: its frames are {image.height}x{image.width}, its metadata says "
                f"{shape[0]}x{shape[1]}"
            )
        if image.encoding != IMAGE_ENCODING:
            raise LogDamagedError(f"{self.path}: its frames are {image.encoding!r}, not mono8")
        return image_payload(shape[0], shape[1], image.frame_id)


def intersection(one: list[tuple[int, int]], two: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Give what lies in both of two sorted lists of ranges [start, stop)."""
    found: list[tuple[int, int]] = []
    i = j = 0
    while i < len(one) and j < len(two):
        low, high = max(one[i][0], two[j][0]), min(one[i][1], two[j][1])
        if low < high:
            found.append((low, high))
        if one[i][1] < two[j][1]:
            i += 1
        else:
            j += 1
    return found
