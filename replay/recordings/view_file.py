"""One file of a recording: the frames of one view, addressed by their number."""

from __future__ import annotations

import bisect
import operator
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from cdmisfa.core.errors import LogDamagedError
from recorder.log.messages import (
    IMAGE_ENCODING,
    IMAGE_SCHEMA,
    METADATA,
    TRUTH_SCHEMA,
    TRUTH_TOPIC,
    VECTOR_SCHEMA,
    Payload,
    image_payload,
    truth_layout,
    truth_tags,
    vector_payload,
    view_topic,
)
from recorder.log.viewfacts import view_facts
from replay.mcap.reader import LogReader
from replay.mcap.records import MalformedRecord
from replay.mcap.tables import MessageTable, windows
from replay.recordings.channel_rows import ChannelRows, PixelRows, Rows, Run, TruthRows
from replay.recordings.scanner import ChunkScanner, RowLayout
from replay.storage.location import Location


class NoRecordingError(LogDamagedError):
    """A log that is no recording of ours; it may be whole, and somebody else's."""


class ViewFile:
    """Frames and ground truth of one file, without a Python object a frame.

    Attributes:
        path: the file.
        facts: what it states about itself.
        ranges: the frames that are there with their ground truth, from and up to before;
            one range, except with `salvage`.
    """

    def __init__(
        self, path: Location, *, salvage: bool = False, cache_bytes: int | None = None
    ) -> None:
        """Open one view's file and check the times of its frames.

        Raises:
            LogDamagedError: it is damaged, or no view of a recording.
        """
        self.path = path
        self._scanner: ChunkScanner | None = None
        self.reader = LogReader(path, salvage=salvage, cache_bytes=cache_bytes)
        try:
            self._open(salvage)
        except BaseException:
            self.reader.close()
            raise

    def _open(self, salvage: bool) -> None:
        records = [m for m in self.reader.metadata if m.name == METADATA]
        if len(records) != 1:
            raise NoRecordingError(
                f"{self.path}: no recording of cdmisfa ({len(records)} {METADATA} records); "
                "cdmisfa learn and convert take logs of others, by their --topic"
            )
        self.facts = view_facts(self.path, records[0].values)
        self.reader.expect(self.reader.segments)
        image = self.facts.dtype == "uint8"
        self._truth_layout = layout = truth_layout(self.facts.truth)
        tags = truth_tags(self.facts.truth)
        offsets = [layout.fields[f"tag_{i}"][1] for i in range(len(tags))] if layout.fields else []
        self._tag_places = [
            place + k for place, tag in zip(offsets, tags, strict=True) for k in range(len(tag))
        ]
        self._tag_bytes = np.frombuffer(b"".join(tags), np.uint8)
        self._frames = self._channel(
            view_topic(self.facts.view), IMAGE_SCHEMA if image else VECTOR_SCHEMA, self._pixels
        )
        self._truth = (
            self._channel(TRUTH_TOPIC, TRUTH_SCHEMA, self._truths) if self.facts.truth else None
        )
        truth = self._truth.runs(self.facts, salvage=salvage) if self._truth is not None else []
        self._number(self._frames.runs(self.facts, salvage=salvage), truth)

    def _number(self, frames: list[Run], truth: list[Run]) -> None:
        """Find the frames that have their ground truth."""
        self._frame_runs, self._truth_runs = frames, truth
        self.ranges = [(run.start, run.stop) for run in frames]
        if self._truth is not None:
            self.ranges = intersection(self.ranges, [(run.start, run.stop) for run in truth])
        self._payload = self._find_payload() if self.ranges else Payload(0, 0, b"")

    def is_at(self, path: Path) -> bool:
        """Whether a path leads to the very file that was opened."""
        return self.reader.is_at(path)

    def refresh(self, path: Path) -> None:
        """Take in the frames that a recorder wrote since; it may have renamed the file.

        Raises:
            LogDamagedError: what was written is damaged.
        """
        self.path = self.reader.path = path
        if self.reader.refresh():
            self._scanner = None
            truth = self._truth.extended(self.facts) if self._truth is not None else []
            self._number(self._frames.extended(self.facts), truth)

    @property
    def count(self) -> int:
        """Frames that are there."""
        return sum(stop - start for start, stop in self.ranges)

    def frames(self, start: int, out: NDArray[Any]) -> None:
        """Fill (n, *frame_shape) with the frames from `start` on, all in one of `ranges`.

        Raises:
            LogDamagedError: a chunk or a message in it is damaged.
        """
        flat = out.reshape(len(out), -1).view(np.uint8)
        self._frames.fill(_row(self._frame_runs, start), flat)

    def truth(self, start: int, out: NDArray[np.float64]) -> None:
        """Fill (n, D) with the ground truth of the frames from `start` on.

        Raises:
            LogDamagedError: a chunk or a message in it is damaged.
        """
        if self._truth is not None:
            self._truth.fill(_row(self._truth_runs, start), out)

    def take(self, start: int, frames: NDArray[Any], truth: NDArray[np.float64]) -> None:
        """Fill frames and ground truth as `frames` and `truth` do, as fast as it goes.

        Args:
            start: the first frame.
            frames: (n, *frame_shape), written.
            truth: (n, D), written.

        Raises:
            LogDamagedError: a chunk or a message in it is damaged.
        """
        if self._scanner is None:
            self._scanner = ChunkScanner(self.reader, self._layouts())
        outs = [frames.reshape(len(frames), -1).view(np.uint8)]
        pieces = self._frames.pieces(_row(self._frame_runs, start), len(frames), 0)
        if self._truth is not None:
            outs.append(truth.view(np.uint8))
            pieces += self._truth.pieces(_row(self._truth_runs, start), len(truth), 1)
            # In the order of the file, so that each chunk is decoded once.
            pieces.sort(key=operator.itemgetter(0))
        for piece in pieces:
            out = outs[piece.which][piece.at : piece.at + piece.n]
            chunk = self._scanner.chunk(piece.segment)
            if chunk is not None:
                self._scanner.copy(chunk, piece.which, piece.low, out)
            elif piece.which:
                self.truth(start + piece.at, truth[piece.at : piece.at + piece.n])
            else:
                self.frames(start + piece.at, frames[piece.at : piece.at + piece.n])

    def close(self) -> None:
        """Let go of the file; harmless when called twice."""
        self.reader.close()

    def _layouts(self) -> list[RowLayout]:
        """Where the frames and the ground truth stand in their messages."""
        payload = self._payload
        place = payload.tail + payload.size
        least = place + len(payload.before)
        marks = [(least - k, byte) for k, byte in enumerate(payload.before)]
        layouts = [
            RowLayout(self._frames.channel.id, least, marks, np.array([place]), payload.size)
        ]
        if self._truth is not None:
            layout = self._truth_layout
            size = layout.itemsize
            marks = [
                (size - at, int(byte))
                for at, byte in zip(self._tag_places, self._tag_bytes, strict=True)
            ]
            places = [size - int(layout.fields[name][1]) for name in self.facts.truth]  # type: ignore[index]
            layouts.append(RowLayout(self._truth.channel.id, size, marks, np.array(places), 8))
        return layouts

    def _channel(
        self, topic: str, schema: str, decode: Callable[[MessageTable], Rows]
    ) -> ChannelRows:
        channels = [c for c in self.reader.channels.values() if c.topic == topic]
        if len(channels) != 1:
            raise LogDamagedError(
                f"{self.path}: {len(channels)} channels on {topic}, a recording has one"
            )
        known = self.reader.schemas.get(channels[0].schema_id)
        if known is None or known.name != schema or channels[0].encoding != "protobuf":
            raise LogDamagedError(f"{self.path}: {topic} does not hold {schema} in protobuf")
        return ChannelRows(self.reader, channels[0], decode)

    def _find_payload(self) -> Payload:
        shape = self.facts.frame_shape
        if self.facts.dtype == "float64":
            return vector_payload(shape[0])
        first = self._frames.first(_row(self._frame_runs, self.ranges[0][0]))
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

    def _pixels(self, table: MessageTable) -> PixelRows:
        payload = self._payload
        before = np.frombuffer(payload.before, np.uint8)
        at = table.at + table.size - payload.tail - payload.size
        if (at - len(before) < table.at).any():
            raise MalformedRecord("a frame is shorter than the others")
        if (table.gather(at - len(before), len(before)) != before).any():
            raise MalformedRecord("a frame is laid out unlike the others")
        return PixelRows(windows(table.data, payload.size), at)

    def _truths(self, table: MessageTable) -> TruthRows:
        names = self.facts.truth
        layout = self._truth_layout
        at = table.at + table.size - layout.itemsize
        if (at < table.at).any():
            raise MalformedRecord("ground truth is shorter than its fields")
        raw = table.gather(at, layout.itemsize)
        if (raw[:, self._tag_places] != self._tag_bytes).any():
            raise MalformedRecord("ground truth is not laid out as cdmisfa does it")
        rows = raw.view(layout)[:, 0]
        values = np.empty((len(rows), len(names)))
        for i, name in enumerate(names):
            values[:, i] = rows[name]
        return TruthRows(values)


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


def _row(runs: list[Run], frame: int) -> int:
    place = bisect.bisect_right(runs, frame, key=lambda run: run.start) - 1
    return runs[place].row_of(frame)
