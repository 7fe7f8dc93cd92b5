"""One file of a recording: the frames of one view, addressed by their number."""

from __future__ import annotations

import bisect
import itertools
import math
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from cdmisfa.blocks import NANOSECONDS
from cdmisfa.errors import LogDamagedError
from recorder.messages import (
    IMAGE_ENCODING,
    IMAGE_SCHEMA,
    METADATA,
    SCHEMA_VERSION,
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
from replay.reader import LogReader
from replay.records import Bytes, Channel, MalformedRecord
from replay.structure import Segment
from replay.tables import MessageTable, windows

MAX_FRAME_VALUES: Final = 64 * 1024 * 1024
MAX_STREAMS: Final = 100_000
MAX_FRAMES: Final = 2**33
_DECODED: Final = 4
_BATCH: Final = 64


class NoRecordingError(LogDamagedError):
    """A log that is no recording of ours; it may be whole, and somebody else's."""


@dataclass(frozen=True, slots=True)
class ViewFacts:
    """What a view's file states about itself, checked.

    Attributes:
        view: name of the stream.
        stream_index: its place among the streams of the recording, from 0.
        frame_shape: (height, width) or (I,).
        dtype: "uint8" or "float64".
        truth: a name for each column of ground truth.
        fps: frames a second.
        start_ns: log time of frame 0.
        first_frame: number of the file's first frame.
        values: the metadata record as it stands there.
    """

    view: str
    stream_index: int
    frame_shape: tuple[int, ...]
    dtype: str
    truth: tuple[str, ...]
    fps: float
    start_ns: int
    first_frame: int
    values: Mapping[str, str]

    def times(self, frames: NDArray[np.int64]) -> NDArray[np.uint64]:
        """Log times of frames, as `SourceSpec.time_ns` gives them."""
        offsets = np.rint(frames * NANOSECONDS / self.fps).astype(np.int64)
        return (self.start_ns + offsets).astype(np.uint64)

    def frames_at(self, times: NDArray[np.uint64]) -> NDArray[np.int64]:
        """Frames at log times; one that is not exactly a frame's gets a frame near it."""
        offsets = times.astype(np.int64) - self.start_ns
        frames = np.rint(offsets * (self.fps / NANOSECONDS))
        return np.asarray(np.clip(frames, -1, MAX_FRAMES), dtype=np.int64)


def view_facts(path: Path, values: Mapping[str, str]) -> ViewFacts:
    """Check a file's statement about itself.

    Raises:
        LogDamagedError: a key is missing or makes no sense.
    """

    def refuse(key: str, remedy: str) -> LogDamagedError:
        value = values.get(key)
        said = "misses" if value is None else f"says {value[:60]!r} for"
        return LogDamagedError(f"{path}: its recording metadata {said} {key}: {remedy}")

    def number(key: str, low: int, high: int, default: str | None = None) -> int:
        text = values.get(key, default)
        if text is None or not text.isascii() or not text.isdigit() or len(text) > 19:
            raise refuse(key, "record it again")
        if not low <= int(text) <= high:
            raise refuse(key, f"it must be in [{low}, {high}]")
        return int(text)

    if values.get("schema") != str(SCHEMA_VERSION):
        raise refuse("schema", f"this version reads schema {SCHEMA_VERSION}")
    view = values.get("view", "")
    if not view:
        raise refuse("view", "record it again")
    shape = values.get("frame_shape", "").split("x")
    if not 1 <= len(shape) <= 2 or not all(
        s.isascii() and s.isdigit() and len(s) < 10 for s in shape
    ):
        raise refuse("frame_shape", "it must be as 48x128 or 2")
    frame_shape = tuple(int(s) for s in shape)
    dtype = values.get("dtype", "")
    if (dtype, len(frame_shape)) not in (("uint8", 2), ("float64", 1)):
        raise refuse("dtype", "it must be uint8 for images, float64 for vectors")
    if not 0 < math.prod(frame_shape) <= MAX_FRAME_VALUES:
        raise refuse("frame_shape", "no frame has that size")
    try:
        fps = float(values.get("fps", ""))
    except ValueError:
        fps = math.nan
    if not 1e-3 <= fps <= 1e6:
        raise refuse("fps", "it must be in [0.001, 1000000]")
    names = values.get("truth", "")
    truth = tuple(names.split(",")) if names else ()
    if len(set(truth)) != len(truth) or not all(n.isidentifier() for n in truth):
        raise refuse("truth", "they must be different names")
    return ViewFacts(
        view,
        number("stream_index", 0, MAX_STREAMS),
        frame_shape,
        dtype,
        truth,
        fps,
        number("start_ns", 0, 2**62),
        number("first_frame", 0, MAX_FRAMES, "0"),
        dict(values),
    )


@dataclass(frozen=True, slots=True)
class Run:
    """Frames `start` to before `stop`, as the messages of a channel from `row` on."""

    start: int
    stop: int
    row: int

    def row_of(self, frame: int) -> int:
        """Number of the message with a frame of the run."""
        return self.row + frame - self.start


class Rows(Protocol):
    """Decoded messages of one chunk."""

    def rows(self, low: int, high: int) -> NDArray[Any]:
        """Give rows `low` to before `high`, or to the last one."""


@dataclass(frozen=True, slots=True)
class PixelRows:
    """Values that stand as bytes in a chunk: (B - size + 1, size) windows, (n,) places."""

    windows: Bytes
    at: NDArray[np.int64]

    def rows(self, low: int, high: int) -> Bytes:
        """Copy the values of some messages, (high - low, size)."""
        return self.windows[self.at[low:high]]


@dataclass(frozen=True, slots=True)
class TruthRows:
    """Ground truth of a chunk, (n, D)."""

    values: NDArray[np.float64]

    def rows(self, low: int, high: int) -> NDArray[np.float64]:
        """Give the ground truth of some messages, (high - low, D)."""
        return self.values[low:high]


class ChannelRows:
    """The messages of one channel, numbered through all chunks of a file.

    Args:
        reader: the file.
        channel: the channel.
        decode: gives for the channel's messages of one chunk an array with a row each.
    """

    def __init__(
        self, reader: LogReader, channel: Channel, decode: Callable[[MessageTable], Rows]
    ) -> None:
        self.channel = channel
        self._reader = reader
        self._decode = decode
        self._decoded: OrderedDict[int, Rows] = OrderedDict()
        self._segments: list[Segment] = []
        counts: list[int] = []
        for segment in reader.segments:
            count = self._count(segment)
            if count:
                self._segments.append(segment)
                counts.append(count)
        self._starts = list(itertools.accumulate(counts, initial=0))

    def runs(self, facts: ViewFacts, *, salvage: bool) -> list[Run]:
        """Number the messages by their log time.

        Args:
            facts: the clock of the recording.
            salvage: take gaps and damaged chunks as several runs.

        Raises:
            LogDamagedError: a log time that is no frame's, a frame twice or out of order,
                and without `salvage` a frame that is missing.
        """
        found: list[Run] = []
        row = 0
        batch: list[NDArray[np.uint64]] = []
        for number in range(len(self._segments)):
            damaged = salvage and self._reader.table(self._segments[number]) is None
            if damaged or len(batch) >= _BATCH:
                self._number(batch, row, facts, found, salvage)
                row, batch = self._starts[number + damaged], []
            if not damaged:
                try:
                    batch.append(self._times(number))
                except MalformedRecord as error:
                    raise LogDamagedError(f"{self._reader.path}: {error}") from None
        self._number(batch, row, facts, found, salvage)
        return found

    def _number(
        self,
        batch: list[NDArray[np.uint64]],
        row: int,
        facts: ViewFacts,
        found: list[Run],
        salvage: bool,
    ) -> None:
        """Add the frames of messages from `row` on to the runs found."""
        if not batch:
            return
        times = np.concatenate(batch)
        frames = facts.frames_at(times)
        exact = facts.times(frames) == times
        before = found[-1].stop if found else facts.first_frame
        steps = np.diff(frames, prepend=before - 1)
        wrong = np.flatnonzero(~exact | (steps < 1 if salvage else steps != 1))
        if len(wrong):
            at = int(wrong[0])
            raise LogDamagedError(
                f"{self._reader.path}: {self.channel.topic}: after frame "
                f"{int(frames[at]) - int(steps[at])} comes log time {times[at]} ns, frame "
                f"{frames[at]}: frames are missing or doubled; run cdmisfa verify, or leave "
                "out what is missing with --salvage"
            )
        edges = [0, *(np.flatnonzero(steps[1:] != 1) + 1).tolist(), len(frames)]
        for low, high in itertools.pairwise(edges):
            start = int(frames[low])
            if found and found[-1].stop == start and found[-1].row_of(start) == row + low:
                found[-1] = Run(found[-1].start, start + high - low, found[-1].row)
            else:
                found.append(Run(start, start + high - low, row + low))

    def _times(self, number: int) -> NDArray[np.uint64]:
        """Log times of the messages in the `number`th chunk that holds any."""
        segment = self._segments[number]
        if segment.indexes:
            own = [p[:, 0] for c, p in self._reader.index(segment) if c == self.channel.id]
            return own[0] if len(own) == 1 else np.concatenate(own)
        return self._table(number).log_time

    def first(self, row: int) -> bytes:
        """Copy the payload of one message."""
        number = bisect.bisect_right(self._starts, row) - 1
        return self._table(number).payload(row - self._starts[number])

    def fill(self, row: int, out: NDArray[Any]) -> None:
        """Fill `out` with the decoded messages from `row` on.

        Raises:
            LogDamagedError: a chunk or a message in it is damaged.
        """
        at, count = 0, len(out)
        number = bisect.bisect_right(self._starts, row) - 1
        while at < count:
            low = row + at - self._starts[number]
            part = self._rows(number).rows(low, low + count - at)
            out[at : at + len(part)] = part
            at, number = at + len(part), number + 1

    def _count(self, segment: Segment) -> int:
        counts = segment.channel_counts()
        if counts is not None:
            return counts.get(self.channel.id, 0)
        table = self._reader.table(segment)
        return 0 if table is None else int((table.channel == self.channel.id).sum())

    def _rows(self, number: int) -> Rows:
        if number in self._decoded:
            return self._decoded[number]
        try:
            rows = self._decode(self._table(number))
        except MalformedRecord as error:
            raise LogDamagedError(
                f"{self._reader.path}: {self._segments[number].name}: {error}"
            ) from None
        if len(self._decoded) >= _DECODED:
            self._decoded.popitem(last=False)
        self._decoded[number] = rows
        return rows

    def _table(self, number: int) -> MessageTable:
        segment = self._segments[number]
        table = self._reader.table(segment)
        if table is None:
            raise LogDamagedError(f"{self._reader.path}: {segment.name} is damaged")
        rows = table.select(np.flatnonzero(table.channel == self.channel.id))
        stated = self._starts[number + 1] - self._starts[number]
        if len(rows) != stated:
            raise LogDamagedError(
                f"{self._reader.path}: {segment.name} holds {len(rows)} messages of "
                f"{self.channel.topic!r}, its index says {stated}; run cdmisfa recover"
            )
        return rows


class ViewFile:
    """Frames and ground truth of one file, without a Python object a frame.

    Attributes:
        path: the file.
        facts: what it states about itself.
        ranges: the frames that are there with their ground truth, from and up to before;
            one range, except with `salvage`.
    """

    def __init__(
        self, path: Path, *, salvage: bool = False, cache_bytes: int | None = None
    ) -> None:
        """Open one view's file and check the times of its frames.

        Raises:
            LogDamagedError: it is damaged, or no view of a recording.
        """
        self.path = path
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
                "for logs of others name their --topic"
            )
        self.facts = view_facts(self.path, records[0].values)
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
        self._frame_runs = self._frames.runs(self.facts, salvage=salvage)
        self._truth_runs: list[Run] = []
        self.ranges = [(run.start, run.stop) for run in self._frame_runs]
        if self._truth is not None:
            self._truth_runs = self._truth.runs(self.facts, salvage=salvage)
            self.ranges = intersection(
                self.ranges, [(run.start, run.stop) for run in self._truth_runs]
            )
        self._payload = self._find_payload() if self.ranges else Payload(0, 0, b"")

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

    def close(self) -> None:
        """Let go of the file; harmless when called twice."""
        self.reader.close()

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
