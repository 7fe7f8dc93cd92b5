"""Reading a run's log in one pass, in stretches of some hundred iterations."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.errors import LogDamagedError
from recorder.log.whole import PARTIAL
from replay.mcap.reader import LogReader
from replay.mcap.records import MalformedRecord
from replay.runs.columns import SignalColumns, columns_of_messages
from replay.runs.log import (
    EVENT_TOPIC,
    PHI_TOPIC,
    SIGNALS_TOPIC,
    TRUTH_TOPIC,
    WATCHED_TOPIC,
    Event,
    RunHeader,
    decode_event,
    decode_image,
    reshaped,
)
from replay.runs.messages import decode_matrix, decode_signals
from replay.runs.wire import alike, column, spans

ITERATIONS = 500
"""Most iterations of a stretch."""

MAX_BYTES = 16 * 1024 * 1024
"""Bytes of messages after which a stretch ends earlier."""

TOPICS = (SIGNALS_TOPIC, WATCHED_TOPIC, PHI_TOPIC, TRUTH_TOPIC, EVENT_TOPIC)

Frames = tuple[NDArray[np.int64], NDArray[Any]]
"""(n,) frames and (n, ...) what belongs to them."""

_T, _VALUES = 1, 3  # fields of a matrix message


@dataclass(frozen=True, slots=True)
class Stretch:
    """What a log holds of some consecutive iterations.

    Attributes:
        signals: the records, in order.
        watched: frames that were watched.
        truth: what the world knew, (n, D).
        phi: (t, (J, I)) weights of the abstraction.
        events: what happened.
    """

    signals: tuple[SignalColumns, ...]
    watched: tuple[Frames, ...]
    truth: tuple[Frames, ...]
    phi: tuple[tuple[int, NDArray[np.float64]], ...]
    events: tuple[Event, ...]


def read_stretches(
    log: Path, header: RunHeader, *, every: int = 1, topics: Sequence[str] = TOPICS
) -> Iterator[Stretch]:
    """Read a run's log from the beginning to the end, once.

    Args:
        log: the file.
        header: what stands at its beginning.
        every: decode images of every this many frames only.
        topics: what is wanted of it.

    Raises:
        LogDamagedError: a message is damaged, or a finished file is cut short.
    """
    kept = _Kept(log, header, every)
    with LogReader(log) as reader:
        wanted = {number: c.topic for number, c in reader.channels.items() if c.topic in topics}
        for _, table in reader.tables(ordered=False):
            data = memoryview(table.data.data)
            for number, log_time, at, size in zip(
                table.channel.tolist(),
                table.log_time.tolist(),
                table.at.tolist(),
                table.size.tolist(),
                strict=True,
            ):
                topic = wanted.get(number)
                if topic is None:
                    continue
                if kept.full(topic):
                    yield kept.stretch()
                kept.add(topic, log_time, data[at : at + size])
        yield kept.stretch()
        if not reader.complete and not log.name.endswith(PARTIAL):
            raise LogDamagedError(f"{log} is cut short: save what is there with cdmisfa recover")


def read_columns(log: Path, header: RunHeader) -> Iterator[SignalColumns]:
    """Every record of a run, in order, as arrays.

    Raises:
        LogDamagedError: a record is damaged, or a finished file is cut short.
    """
    for stretch in read_stretches(log, header, topics=(SIGNALS_TOPIC,)):
        yield from stretch.signals


class _Kept:
    """Messages that wait to be decoded together."""

    def __init__(self, log: Path, header: RunHeader, every: int) -> None:
        self._log = log
        self._header = header
        self._every = every
        self._images = header.spec.images
        self._data: dict[str, list[bytes]] = {topic: [] for topic in TOPICS}
        self._frames: dict[str, list[int]] = {topic: [] for topic in TOPICS}
        self._bytes = 0

    def full(self, topic: str) -> bool:
        """Whether a stretch ends before this message: if it may be, with a whole iteration."""
        if topic != SIGNALS_TOPIC:
            return self._bytes >= 4 * MAX_BYTES
        return self._bytes >= MAX_BYTES or len(self._data[topic]) >= ITERATIONS

    def add(self, topic: str, log_time: int, data: memoryview) -> None:
        if topic == EVENT_TOPIC or (topic == WATCHED_TOPIC and self._images):
            t = self._header.frame_at(log_time)
            if topic == WATCHED_TOPIC and t % self._every:
                return
            self._frames[topic].append(t)
        self._data[topic].append(bytes(data))
        self._bytes += len(data)

    def stretch(self) -> Stretch:
        """What waits, decoded; nothing waits any longer."""
        data, frames, log = self._data, self._frames, self._log
        self._data = {topic: [] for topic in TOPICS}
        self._frames = {topic: [] for topic in TOPICS}
        self._bytes = 0
        spec = self._header.spec
        if self._images:
            watched = self._pictures(frames[WATCHED_TOPIC], data[WATCHED_TOPIC])
        else:
            watched = self._matrices(WATCHED_TOPIC, data, spec.frame_shape)
        events = zip(data[EVENT_TOPIC], frames[EVENT_TOPIC], strict=True)
        return Stretch(
            signals=self._records(data[SIGNALS_TOPIC]),
            watched=watched,
            truth=self._matrices(TRUTH_TOPIC, data, (len(spec.truth),)),
            phi=tuple(decode_matrix(d, f"{log} {PHI_TOPIC}") for d in data[PHI_TOPIC]),
            events=tuple(decode_event(d, t, log) for d, t in events),
        )

    def _records(self, data: list[bytes]) -> tuple[SignalColumns, ...]:
        where = f"{self._log} {SIGNALS_TOPIC}"
        version = self._header.schema
        found = columns_of_messages(data, lambda d: decode_signals(d, where, version))
        streams = len(self._header.spec.streams)
        return tuple(_checked(columns, streams, where) for columns in found)

    def _pictures(self, frames: list[int], data: list[bytes]) -> tuple[Frames, ...]:
        if not data:
            return ()
        shape = self._header.spec.frame_shape
        pixels = np.empty((len(data), *shape), dtype=np.uint8)
        for place, entry in zip(pixels, data, strict=True):
            place[:] = decode_image(entry, shape, self._log)
        return ((np.array(frames, dtype=np.int64), pixels),)

    def _matrices(
        self, topic: str, data: dict[str, list[bytes]], shape: tuple[int, ...]
    ) -> tuple[Frames, ...]:
        """Rows of matrix messages with a frame each, all of one size together."""

        def decode(entry: bytes) -> tuple[int, NDArray[np.float64]]:
            return decode_matrix(entry, f"{self._log} {topic}")

        return tuple(
            (frames, reshaped(values, (-1, *shape), self._log))
            for _, group in groupby(data[topic], key=len)
            for frames, values in _rows(list(group), decode)
        )


def _checked(columns: SignalColumns, streams: int, where: str) -> SignalColumns:
    """Records as they are, where they are about streams that there are.

    Raises:
        LogDamagedError: they are not.
    """
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


def _rows(
    messages: list[bytes], decode: Callable[[bytes], tuple[int, NDArray[np.float64]]]
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Frames and rows of matrix messages of one size."""
    _, first = decode(messages[0])
    try:
        places = spans(messages[0])
        known = [places[_T], places[_VALUES]]
    except (MalformedRecord, KeyError):
        known = []
    table = alike(messages, known) if known else None
    if table is not None and known[1][1] - known[1][0] == 8 * first.size:
        begins = column(table, known[0], "<i8")
        values = column(table, known[1], "<f8").reshape(-1, *first.shape)
        yield (begins + np.arange(len(first))).reshape(-1), values.reshape(-1, first.shape[1])
        return
    for message in messages:
        t, rows = decode(message)
        yield t + np.arange(len(rows)), rows
