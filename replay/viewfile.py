"""One file of a recording: the frames of one view, addressed by their number."""

from __future__ import annotations

import bisect
import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from cdmisfa.blocks import NANOSECONDS
from cdmisfa.errors import LogDamagedError
from recorder.messages import (
    IMAGE_ENCODING,
    IMAGE_SCHEMA,
    TRUTH_SCHEMA,
    VECTOR_SCHEMA,
    Payload,
    image_payload,
    truth_layout,
    truth_tags,
    vector_payload,
)
from recorder.viewlog import METADATA, SCHEMA_VERSION, TRUTH_TOPIC, view_topic
from replay.reader import LogReader
from replay.records import Bytes, Channel, MalformedRecord
from replay.structure import Segment
from replay.tables import MessageTable

MAX_FRAME_VALUES: Final = 64 * 1024 * 1024
MAX_STREAMS: Final = 100_000
MAX_FRAMES: Final = 2**33


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


class ChannelRows:
    """The messages of one channel, numbered through all chunks of a file."""

    def __init__(self, reader: LogReader, channel: Channel) -> None:
        self.channel = channel
        self._reader = reader
        self._segments: list[Segment] = []
        counts: list[int] = []
        for segment in reader.segments:
            count = self._count(segment)
            if count:
                self._segments.append(segment)
                counts.append(count)
        self._starts = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])

    def __len__(self) -> int:
        return int(self._starts[-1])

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
        for number in range(len(self._segments)):
            try:
                times = self._times(number)
            except MalformedRecord as error:
                raise LogDamagedError(f"{self._reader.path}: {error}") from None
            if salvage and self._reader.table(self._segments[number]) is None:
                continue
            first = int(self._starts[number])
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
                row = first + low
                if found and found[-1].stop == start and found[-1].row_of(start) == row:
                    found[-1] = Run(found[-1].start, start + high - low, found[-1].row)
                else:
                    found.append(Run(start, start + high - low, row))
        return found

    def _times(self, number: int) -> NDArray[np.uint64]:
        """Log times of the messages in the `number`th chunk that holds any."""
        segment = self._segments[number]
        if segment.indexes:
            pairs = [p for c, p in self._reader.index(segment) if c == self.channel.id]
            return np.concatenate(pairs)[:, 0]
        return self._rows(number)[0].log_time

    def pieces(self, start: int, count: int) -> list[tuple[MessageTable, int]]:
        """Give `count` messages from row `start` on, chunk by chunk, with where each goes."""
        found: list[tuple[MessageTable, int]] = []
        at, stop = start, start + count
        number = int(np.searchsorted(self._starts, start, side="right")) - 1
        while at < stop:
            table, first = self._rows(number)
            low, high = at - first, min(stop, first + len(table)) - first
            found.append((table.select(np.arange(low, high)), at - start))
            at, number = first + high, number + 1
        return found

    def _count(self, segment: Segment) -> int:
        counts = segment.channel_counts()
        if counts is not None:
            return counts.get(self.channel.id, 0)
        table = self._reader.table(segment)
        return 0 if table is None else int((table.channel == self.channel.id).sum())

    def _rows(self, number: int) -> tuple[MessageTable, int]:
        segment = self._segments[number]
        table = self._reader.table(segment)
        if table is None:
            raise LogDamagedError(f"{self._reader.path}: {segment.name} is damaged")
        rows = table.select(np.flatnonzero(table.channel == self.channel.id))
        first, stop = int(self._starts[number]), int(self._starts[number + 1])
        if len(rows) != stop - first:
            raise LogDamagedError(
                f"{self._reader.path}: {segment.name} holds {len(rows)} messages of "
                f"{self.channel.topic!r}, its index says {stop - first}; run cdmisfa recover"
            )
        return rows, first


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
            raise LogDamagedError(
                f"{self.path}: no recording of cdmisfa ({len(records)} {METADATA} records); "
                "for logs of others name their --topic"
            )
        self.facts = view_facts(self.path, records[0].values)
        image = self.facts.dtype == "uint8"
        self._frames = self._channel(
            view_topic(self.facts.view), IMAGE_SCHEMA if image else VECTOR_SCHEMA
        )
        self._truth = self._channel(TRUTH_TOPIC, TRUTH_SCHEMA) if self.facts.truth else None
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
        for table, at in self._frames.pieces(_row(self._frame_runs, start), len(out)):
            flat[at : at + len(table)] = self._values(table)

    def truth(self, start: int, out: NDArray[np.float64]) -> None:
        """Fill (n, D) with the ground truth of the frames from `start` on.

        Raises:
            LogDamagedError: a chunk or a message in it is damaged.
        """
        if self._truth is None:
            return
        layout, tags = truth_layout(self.facts.truth), truth_tags(self.facts.truth)
        for table, at in self._truth.pieces(_row(self._truth_runs, start), len(out)):
            raw = self._windows(table, table.at + table.size - layout.itemsize, layout.itemsize)
            rows = np.ascontiguousarray(raw).view(layout)[:, 0]
            for i, (name, tag) in enumerate(zip(self.facts.truth, tags, strict=True)):
                if (rows[f"tag_{i}"] != np.void(tag)).any():
                    raise LogDamagedError(f"{self.path}: /truth is not laid out as cdmisfa does it")
                out[at : at + len(table), i] = rows[name]

    def close(self) -> None:
        """Let go of the file; harmless when called twice."""
        self.reader.close()

    def _channel(self, topic: str, schema: str) -> ChannelRows:
        channels = [c for c in self.reader.channels.values() if c.topic == topic]
        if len(channels) != 1:
            raise LogDamagedError(
                f"{self.path}: {len(channels)} channels on {topic}, a recording has one"
            )
        known = self.reader.schemas.get(channels[0].schema_id)
        if known is None or known.name != schema or channels[0].encoding != "protobuf":
            raise LogDamagedError(f"{self.path}: {topic} does not hold {schema} in protobuf")
        return ChannelRows(self.reader, channels[0])

    def _find_payload(self) -> Payload:
        shape = self.facts.frame_shape
        if self.facts.dtype == "float64":
            return vector_payload(shape[0])
        (table, _), *_ = self._frames.pieces(_row(self._frame_runs, self.ranges[0][0]), 1)
        try:
            image = RawImage.FromString(table.payload(0))
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

    def _values(self, table: MessageTable) -> Bytes:
        payload = self._payload
        before = len(payload.before)
        at = table.at + table.size - payload.tail - payload.size
        if (at - before < table.at).any():
            raise LogDamagedError(f"{self.path}: a frame is shorter than the others")
        tag = self._windows(table, at - before, before)
        if (tag != np.frombuffer(payload.before, np.uint8)).any():
            raise LogDamagedError(f"{self.path}: a frame is laid out unlike the others")
        return self._windows(table, at, payload.size)

    def _windows(self, table: MessageTable, at: NDArray[np.int64], size: int) -> Bytes:
        try:
            return table.windows(at, size)
        except MalformedRecord as error:
            raise LogDamagedError(f"{self.path}: {error}") from None


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
