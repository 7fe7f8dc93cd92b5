"""Messages to be played: those of MCAP files as they are, the frames of other logs as images."""

from __future__ import annotations

import contextlib
import heapq
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.errors import UsageError
from recorder.log.messages import (
    ENCODING,
    TRUTH_TOPIC,
    ImageEncoder,
    TruthEncoder,
    VectorEncoder,
    view_topic,
)
from recorder.mcap.reader import LogReader
from replay.camera_logs.opening import fits_topic
from replay.camera_logs.options import CameraOptions
from replay.inputs import Logged, open_to_look, refuse_what_is_no_log
from replay.storage.opening import log_files, open_store, starts_as_log

READ_AHEAD = 50
"""Frames that are read at once."""


@dataclass(frozen=True, slots=True)
class Topic:
    """What messages are on, and how they are decoded."""

    name: str
    encoding: str
    schema_name: str
    schema_encoding: str
    schema: bytes


class Told(NamedTuple):
    """A message with its log time, in nanoseconds."""

    time_ns: int
    topic: Topic
    data: bytes


class Frame(NamedTuple):
    """What every stream shows at frame t, None where it shows nothing, and what the world knows."""

    time_ns: int
    t: int
    shown: tuple[NDArray[Any] | None, ...]
    truth: NDArray[np.float64] | None


class Feed(Protocol):
    """Messages of a log, from its first to its last, as often as they are gone through.

    Attributes:
        topics: all that there are.
        start: log time of the first message, in nanoseconds.
        stop: log time of the last.
    """

    topics: tuple[Topic, ...]
    start: int
    stop: int

    def messages(self) -> Iterator[Told]:
        """The messages in the order of their times."""


@contextlib.contextmanager
def opened_source(
    paths: Sequence[Path],
    fps: float | None,
    cameras: CameraOptions | None = None,
    about: Callable[[Logged], None] = lambda source: None,
) -> Iterator[Logged]:
    """The frames of a recording, or of camera logs of others, from the first on.

    Args:
        paths: see `play_as_robot`.
        fps: frames a second of logs that tell none.
        cameras: what else is taken of camera logs of others, and how.
        about: given them once they are open, to say what they are.

    Raises:
        UsageError: there is no such log, or it is a run.
        LogDamagedError: it is damaged.
    """
    try:
        source = open_to_look(paths, replace(cameras or CameraOptions(), rate=fps))
    except UsageError as error:  # where --rate is how fast it is played
        raise UsageError(str(error).replace("with --rate", "with --fps")) from None
    with contextlib.closing(source):
        about(source)
        yield source


@contextlib.contextmanager
def opened_feed(
    paths: Sequence[Path],
    fps: float | None = None,
    cameras: CameraOptions | None = None,
    about: Callable[[Logged], None] = lambda source: None,
) -> Iterator[Feed]:
    """The messages of a recording, or of camera logs of others; see `opened_source`.

    Raises:
        UsageError: there is no such log, or it is a run.
        LogDamagedError: it is damaged.
    """
    for path in paths:
        refuse_what_is_no_log(path)
    cameras = cameras or CameraOptions()
    as_they_are = replace(cameras, topics=()) == CameraOptions()
    with contextlib.ExitStack() as stack:
        if as_they_are and all(_is_mcap(path) for path in paths):
            files = log_files(paths)
            readers = [stack.enter_context(LogReader(open_store(file))) for file in files]
            yield LoggedFeed(readers, cameras.topics)
        else:
            yield FrameFeed(stack.enter_context(opened_source(paths, fps, cameras, about)))


def _is_mcap(path: Path) -> bool:
    if path.is_dir():
        return any(path.glob("*.mcap*"))
    return starts_as_log(path)


class LoggedFeed:
    """The messages of MCAP files, bytes and times as they are; what two files tell is told once.

    Args:
        readers: of the files.
        topics: those that are played, or patterns of them; without any all.

    Raises:
        UsageError: there are no messages, or no such topic.
    """

    def __init__(self, readers: Sequence[LogReader], topics: Sequence[str] = ()) -> None:
        self._readers = readers
        self._known = [_topics(reader) for reader in readers]
        there = sorted({topic.name for known in self._known for topic in known.values()})
        for asked in topics:
            if not any(fits_topic(name, asked) for name in there):
                raise UsageError(f"{readers[0].path}: no topic {asked}; it has: {', '.join(there)}")
        if topics:
            self._known = [
                {
                    n: t
                    for n, t in known.items()
                    if any(fits_topic(t.name, asked) for asked in topics)
                }
                for known in self._known
            ]
        self.topics = tuple(dict.fromkeys(t for known in self._known for t in known.values()))
        segments = [s for reader in readers for s in reader.segments if s.size]
        if not segments:
            raise UsageError(f"{readers[0].path} has no messages: there is nothing to play")
        self.start = min(segment.start for segment in segments)
        self.stop = max(segment.end for segment in segments)

    def messages(self) -> Iterator[Told]:
        """See `Feed`."""
        files = zip(self._readers, self._known, strict=True)
        now, told = -1, set[Told]()
        each = [_told(reader, known) for reader, known in files]
        for message in heapq.merge(*each, key=lambda message: message.time_ns):
            if message.time_ns != now:
                now, told = message.time_ns, set()
            if message not in told:  # every file of a recording has the truth
                told.add(message)
                yield message


def _topics(reader: LogReader) -> dict[int, Topic]:
    topics = {}
    for number, channel in reader.channels.items():
        schema = reader.schemas.get(channel.schema_id)
        named = ("", "", b"") if schema is None else (schema.name, schema.encoding, schema.data)
        topics[number] = Topic(channel.topic, channel.encoding, *named)
    return topics


def _told(reader: LogReader, known: dict[int, Topic]) -> Iterator[Told]:
    for message in reader.messages():
        if message.channel.id in known:
            yield Told(message.log_time, known[message.channel.id], message.data)


class FrameFeed:
    """The frames of a source as messages, as a recording of them would hold.

    Args:
        source: of frames; left open.
    """

    def __init__(self, source: Logged) -> None:
        self._source, spec = source, source.spec
        self._first = source.t
        self.start = spec.time_ns(self._first)
        self.stop = spec.time_ns(self._first + source.frames - 1)
        self._encoders: list[Any] = [
            ImageEncoder(spec.frame_shape[0], spec.frame_shape[1], name)
            if spec.images
            else VectorEncoder()
            for name in spec.streams
        ]
        topics = [
            _topic(view_topic(name), encoder)
            for name, encoder in zip(spec.streams, self._encoders, strict=True)
        ]
        self._truth = TruthEncoder(spec.truth) if spec.truth else None
        if self._truth is not None:
            topics.append(_topic(TRUTH_TOPIC, self._truth))
        self.topics = tuple(topics)

    def messages(self) -> Iterator[Told]:
        """See `Feed`."""
        for frame in frames_of(self._source, self._first):
            told = zip(self.topics, self._encoders, frame.shown, strict=False)
            for topic, encode, shown in told:
                if shown is not None:
                    yield Told(frame.time_ns, topic, encode(frame.time_ns, shown))
            if self._truth is not None and frame.truth is not None:
                data = self._truth(frame.time_ns, frame.truth)
                yield Told(frame.time_ns, self.topics[-1], data)


def _topic(name: str, encoder: Any) -> Topic:
    return Topic(name, ENCODING, encoder.schema, ENCODING, encoder.schema_data())


def frames_of(source: Logged, first: int) -> Iterator[Frame]:
    """Every frame of a source from `first` on, with what each stream shows at it."""
    spec, end = source.spec, first + source.frames
    for start in range(first, end, READ_AHEAD):
        stop = min(start + READ_AHEAD, end)
        source.seek(start)
        blocks = source.take_all(stop - start)
        for t in range(start, stop):
            shown: list[NDArray[Any] | None] = [None] * len(spec.streams)
            truth = None
            for block in blocks:
                if block.t <= t < block.t + len(block):
                    shown[block.stream] = block.frames[t - block.t]
                    truth = block.truth[t - block.t]
            yield Frame(spec.time_ns(t), t, tuple(shown), truth)
