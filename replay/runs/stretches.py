"""Reading a run's log in one pass, in stretches of some hundred iterations."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf import Log_pb2, RawImage_pb2
from numpy.typing import NDArray

from cdmisfa.core.errors import LogDamagedError
from recorder.mcap.reader import LogReader
from recorder.mcap.records import Channel, MalformedRecord
from recorder.mcap.store import PARTIAL
from recorder.mcap.tables import MessageTable
from replay.runs.columns import Blocks, SignalColumns, columns_of_messages
from replay.runs.folders import run_log
from replay.runs.log import (
    EVENT_TOPIC,
    PHI_TOPIC,
    SIGNALS_TOPIC,
    TRUTH_TOPIC,
    WATCHED_TOPIC,
    Event,
    RunHeader,
    read_header,
)
from replay.runs.messages import decode_matrices, decode_matrix, decode_signals, parsed, spans

ITERATIONS = 500
"""Most iterations of a stretch."""

MAX_BYTES = 16 * 1024 * 1024
"""Bytes of messages after which a stretch ends earlier."""

TOPICS = (SIGNALS_TOPIC, WATCHED_TOPIC, PHI_TOPIC, TRUTH_TOPIC, EVENT_TOPIC)

Frames = tuple[NDArray[np.int64], NDArray[Any]]
"""(n,) frames and (n, ...) what belongs to them."""

_TIMESTAMP, _LONG = b"\x0a", b"\x80"
"""The tag of an image's time, which comes first; its length, where that takes more than a byte."""

_LAYOUTS = 64
"""Most layouts of images that are remembered: one for each stream and size."""

_ITERATION = re.compile(r"iteration (\d{1,18})")


@dataclass(frozen=True, slots=True)
class Stretch:
    """What a log holds of some consecutive iterations.

    Attributes:
        blocks: of the records, after the last one before them, which the first of the other
            messages may belong to; none where no records were wanted.
        truth: what the world knew, (n, D).
        phi: (t, (J, I)) weights of the abstraction.
    """

    signals: tuple[SignalColumns, ...]
    blocks: Blocks
    watched: tuple[Frames, ...]
    truth: tuple[Frames, ...]
    phi: tuple[tuple[int, NDArray[np.float64]], ...]
    events: tuple[Event, ...]


def read_stretches(
    path: Path,
    header: RunHeader | None = None,
    *,
    every: int = 1,
    topics: Sequence[str] = TOPICS,
    start: int = 0,
) -> Iterator[Stretch]:
    """Read a run's log to the end, once.

    Args:
        path: the run's folder, or its log.
        header: what stands at the beginning of its log, where that was read already.
        every: decode images of every this many frames only.
        topics: what is wanted of it.
        start: the frame to begin at, the first of a block.

    Raises:
        UsageError: there is no such run, or it is of a later version of this software.
        LogDamagedError: a message is damaged, or a finished file is cut short.
    """
    log = run_log(path)
    header = header or read_header(log)
    with LogReader(log) as reader:
        stretches = Stretches(log, header, reader.channels, every=every, topics=topics)
        since = header.spec.time_ns(start) if start else None
        for _, table in reader.tables(ordered=False, start=since):
            yield from stretches.take(table)
        yield stretches.rest()
        if not reader.complete and not log.name.endswith(PARTIAL):
            raise LogDamagedError(f"{log} is cut short: save what is there with cdmisfa recover")


def read_columns(
    path: Path, header: RunHeader | None = None, *, start: int = 0
) -> Iterator[SignalColumns]:
    """The records of a run from a frame on, in order, as arrays; see `read_stretches`."""
    for stretch in read_stretches(path, header, topics=(SIGNALS_TOPIC,), start=start):
        yield from stretch.signals


class Stretches:
    """Makes stretches of a run's log from its chunks, which are given in file order.

    Args:
        log: of the run.
        header: what stands at its beginning.
        channels: of the log.
        every: see `read_stretches`, as `topics`.
    """

    def __init__(
        self,
        log: Path,
        header: RunHeader,
        channels: Mapping[int, Channel],
        *,
        every: int = 1,
        topics: Sequence[str] = TOPICS,
    ) -> None:
        self._log, self._header, self._every = log, header, every
        self._wanted = {n: c.topic for n, c in channels.items() if c.topic in topics}
        self._waiting = _Waiting(log, header)

    def take(self, table: MessageTable) -> Iterator[Stretch]:
        """Take the messages of the next chunk, and give the stretches that end with them."""
        spec = self._header.spec
        wanted = np.isin(table.channel, list(self._wanted))
        frames = spec.frames_at(table.log_time)
        if spec.images and self._every > 1:
            shown = [n for n, topic in self._wanted.items() if topic == WATCHED_TOPIC]
            wanted &= ~np.isin(table.channel, shown) | (frames % self._every == 0)
        if not wanted.all():
            table, frames = table.select(wanted), frames[wanted]
        data = memoryview(table.data.data)
        for number, t, at, size in zip(
            table.channel.tolist(),
            frames.tolist(),
            table.at.tolist(),
            table.size.tolist(),
            strict=True,
        ):
            topic = self._wanted[number]
            if self._waiting.full(topic):
                yield self.rest()
            self._waiting.add(topic, t, bytes(data[at : at + size]))

    def rest(self) -> Stretch:
        """What was taken since the last stretch ended, as one."""
        stretch = self._waiting.stretch()
        self._waiting = _Waiting(self._log, self._header, (stretch.blocks.last(),))
        return stretch


class _Waiting:
    """Messages that wait to be decoded together."""

    def __init__(self, log: Path, header: RunHeader, before: tuple[Blocks, ...] = ()) -> None:
        self.header = header
        self._log, self._before = log, before
        self._data: dict[str, list[bytes]] = {topic: [] for topic in TOPICS}
        self._frames: dict[str, list[int]] = {topic: [] for topic in TOPICS}
        self._bytes = 0

    def full(self, topic: str) -> bool:
        """Whether a stretch ends before this message: if it may be, with a whole iteration."""
        if topic != SIGNALS_TOPIC:
            return self._bytes >= 4 * MAX_BYTES
        return self._bytes >= MAX_BYTES or len(self._data[topic]) >= ITERATIONS

    def add(self, topic: str, t: int, data: bytes) -> None:
        self._data[topic].append(data)
        self._frames[topic].append(t)
        self._bytes += len(data)

    def stretch(self) -> Stretch:
        """What waits, decoded."""
        log, spec, data = self._log, self.header.spec, self._data
        watched = self._pictures() if spec.images else self._rows(WATCHED_TOPIC, spec.frame_shape)
        signals = self._records()
        events = zip(data[EVENT_TOPIC], self._frames[EVENT_TOPIC], strict=True)
        return Stretch(
            signals=signals,
            blocks=Blocks.joined([*self._before, *map(Blocks.of, signals)]),
            watched=watched,
            truth=self._rows(TRUTH_TOPIC, (len(spec.truth),)),
            phi=tuple(decode_matrix(d, f"{log} {PHI_TOPIC}") for d in data[PHI_TOPIC]),
            events=tuple(_event(d, t, log) for d, t in events),
        )

    def _records(self) -> tuple[SignalColumns, ...]:
        where, version = f"{self._log} {SIGNALS_TOPIC}", self.header.schema
        found = columns_of_messages(
            self._data[SIGNALS_TOPIC], lambda d: decode_signals(d, where, version)
        )
        streams = len(self.header.spec.streams)
        return tuple(_checked(columns, streams, where) for columns in found)

    def _pictures(self) -> tuple[Frames, ...]:
        data = self._data[WATCHED_TOPIC]
        if not data:
            return ()
        shape, images = self.header.spec.frame_shape, PixelFinder(f"{self._log} {WATCHED_TOPIC}")
        found = [images.pixels(entry) for entry in data]
        for pixels in found:
            if len(pixels) != math.prod(shape):
                _reshaped(np.frombuffer(pixels, np.uint8), shape, self._log)
        whole = np.frombuffer(b"".join(found), np.uint8).reshape(len(data), *shape)
        return ((np.array(self._frames[WATCHED_TOPIC], dtype=np.int64), whole),)

    def _rows(self, topic: str, shape: tuple[int, ...]) -> tuple[Frames, ...]:
        """Rows of matrix messages with a frame each, all of one size together."""
        return tuple(
            (frames, _reshaped(values, (-1, *shape), self._log))
            for _, group in groupby(self._data[topic], key=len)
            for frames, values in decode_matrices(list(group), f"{self._log} {topic}")
        )


class PixelFinder:
    """Finds the pixels in `foxglove.RawImage` messages, most of which differ in them and in time.

    Args:
        where: what is said of a message that is none.
    """

    def __init__(self, where: str) -> None:
        self._where = where
        self._around: list[tuple[bytes, int, bytes]] = []

    def pixels(self, entry: bytes) -> memoryview:
        """The bytes of an image, where they lie in its message."""
        if entry[:1] == _TIMESTAMP and entry[1:2] < _LONG:
            rest = 2 + sum(entry[1:2])
            for i, (before, size, after) in enumerate(self._around):
                start = rest + len(before)
                stop = start + size
                if entry[rest:start] == before and entry[stop:] == after:
                    if i:  # the next one is of the same stream most of the time
                        self._around.insert(0, self._around.pop(i))
                    return memoryview(entry)[start:stop]
        image = parsed(RawImage_pb2.RawImage, entry, self._where)
        self._learn(entry)
        return memoryview(image.data)

    def _learn(self, entry: bytes) -> None:
        """Remember what stands around the pixels, where nothing but the time stands before."""
        try:
            places = spans(entry)
        except MalformedRecord:
            return
        time, pixels = places.get(1, (0, 0)), places.get(6, (0, 0))
        if time[0] == 2 and pixels[0] > time[1] and time[1] - 2 < 0x80:
            around = entry[time[1] : pixels[0]], pixels[1] - pixels[0], entry[pixels[1] :]
            self._around = [around, *self._around[: _LAYOUTS - 1]]


def _checked(columns: SignalColumns, streams: int, where: str) -> SignalColumns:
    """Records as they are, where they are about the run's streams."""
    watched, rewards = columns["stream"], columns["R"]
    if (
        watched.min() < 0
        or watched.max() >= streams
        or columns["policy"].shape[1] != streams
        or columns["Q"].shape[1:] != (streams, 2)
        or (rewards.size and rewards.shape[1:] != (streams, 2, streams))
    ):
        raise LogDamagedError(f"{where}: a record is about other streams than the run's")
    return columns


def _event(data: bytes, t: int, log: Path) -> Event:
    entry = parsed(Log_pb2.Log, data, f"{log} {EVENT_TOPIC}")
    match = _ITERATION.fullmatch(entry.name)
    level = Log_pb2.Log.Level.Name(entry.level) if entry.level <= 5 else "INFO"
    return Event(t, int(match[1]) if match else -1, entry.message, level)


def _reshaped(values: NDArray[Any], shape: tuple[int, ...], log: Path) -> NDArray[Any]:
    try:
        return values.reshape(shape)
    except ValueError as error:
        raise LogDamagedError(f"{log}: {values.size} values do not fill {shape}") from error
