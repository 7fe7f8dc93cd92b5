"""What is played, and when it is due: messages of MCAP files as they are, frames of other logs."""

from __future__ import annotations

import contextlib
import heapq
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import LogDamagedError, UsageError
from recorder.log.messages import (
    ENCODING,
    TRUTH_TOPIC,
    ImageEncoder,
    TruthEncoder,
    VectorEncoder,
    view_topic,
)
from recorder.mcap.reader import Check, LogReader
from replay.camera_logs.opening import fits_topic
from replay.camera_logs.options import CameraOptions
from replay.inputs import About, Logged, open_to_look, refuse_what_is_no_log
from replay.storage.identity import AT_ONCE
from replay.storage.opening import log_files, open_store, starts_as_log

READ_AHEAD: Final = 50
"""Frames that are read at once."""

SLICE: Final = 0.1
"""Most seconds between two looks at whether to stop."""


@dataclass(frozen=True, slots=True)
class Playback:
    """How a recording, or camera logs of others, are played.

    Attributes:
        rate: how many seconds of the recording pass in one.
        loop: begin again at the end, after the mean step between two times.
        fps: frames a second of logs that tell none, as folders of pictures.
        cameras: what is taken of camera logs of others; their rate is `fps`.
        about: given what is played frame by frame before that, to say what it is.
        warn: told what is wrong with logs of which messages are played as they are.
        stop: asked while waiting; true ends it.
        progress: told the seconds that were played, and all that there are.
    """

    rate: float = 1.0
    loop: bool = False
    fps: float | None = None
    cameras: CameraOptions = CameraOptions()
    about: About = lambda source: None
    warn: Callable[[str], None] = lambda line: None
    stop: Callable[[], bool] = lambda: False
    progress: Callable[[float, float | None], None] = lambda done, total: None


@dataclass
class Played:
    """What was played.

    Attributes:
        count: how many items.
        seconds: of log time, all rounds together.
        behind: seconds by which the last item came late.
        stopped: whether it was ended before the last item.
    """

    count: int = 0
    seconds: float = 0.0
    behind: float = 0.0
    stopped: bool = False


@dataclass(frozen=True, slots=True)
class Topic:
    """What messages are on, and how they are decoded."""

    name: str
    encoding: str
    schema_name: str
    schema_encoding: str
    schema: bytes


class DueMessage(NamedTuple):
    """A message with its log time, in nanoseconds, at which it is due."""

    time_ns: int
    topic: Topic
    data: bytes


class Frame(NamedTuple):
    """What every stream shows at a frame, None where it shows nothing, and what the world knows."""

    time_ns: int
    shown: tuple[NDArray[Any] | None, ...]
    truth: NDArray[np.float64] | None


Item = TypeVar("Item", DueMessage, Frame)


@dataclass(frozen=True, slots=True)
class Feed(Generic[Item]):
    """Messages or frames of a log, as often as they are gone through.

    Attributes:
        start: log time of the first, in nanoseconds.
        stop: log time of the last.
        items: gives them in the order of their times.
        topics: of messages, all that there are.
    """

    start: int
    stop: int
    items: Callable[[], Iterable[Item]]
    topics: tuple[Topic, ...] = ()

    def seconds(self, how: Playback) -> float | None:
        """Seconds from the first to the last; None where it never ends."""
        return None if how.loop else (self.stop - self.start) / NANOSECONDS


def paced(
    feed: Feed[Item],
    how: Playback,
    played: Played,
    *,
    now: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[tuple[int, Item]]:
    """Give each item at its own time, counted from the first: what is late delays none after it.

    Args:
        feed: of the items.
        how: the rate, whether it loops, and when it stops.
        played: told of what was given.
        now: the time, in seconds.
        sleep: waits so many seconds.

    Yields:
        The nanoseconds of log time since the first item, and the item.
    """
    begin = None
    for since, item in _rounds(feed, loop=how.loop):
        begin = now() if begin is None else begin
        due = begin + since / NANOSECONDS / how.rate
        while (left := due - now()) > 0 and not how.stop():
            sleep(min(left, SLICE))
        if how.stop():
            played.stopped = True
            return
        played.count += 1
        played.seconds = since / NANOSECONDS
        played.behind = max(-left, 0.0)
        yield since, item


def _rounds(feed: Feed[Item], *, loop: bool) -> Iterator[tuple[int, Item]]:
    """Items with the nanoseconds since the first, again and again where it loops."""
    before = 0
    while True:
        times, last = 0, -1
        for item in feed.items():
            times, last = times + (item.time_ns != last), item.time_ns
            yield before + item.time_ns - feed.start, item
        if not loop or times == 0:
            return
        before += round((feed.stop - feed.start) * times / max(times - 1, 1)) or NANOSECONDS


@contextlib.contextmanager
def opened_source(paths: Sequence[Path], how: Playback) -> Iterator[Logged]:
    """The frames of a recording, or of camera logs of others, from the first on.

    Raises:
        UsageError: there is no such log, or it is a run.
        LogDamagedError: it is damaged.
    """
    try:
        source = open_to_look(paths, replace(how.cameras, rate=how.fps))
    except UsageError as error:  # here --rate is the speed
        raise UsageError(str(error).replace("with --rate", "with --fps")) from None
    with contextlib.closing(source):
        how.about(source)
        yield source


@contextlib.contextmanager
def opened_messages(paths: Sequence[Path], how: Playback) -> Iterator[Feed[DueMessage]]:
    """The messages of a recording, or of camera logs of others; raises as `opened_source`."""
    for path in paths:
        refuse_what_is_no_log(path)
    as_they_are = replace(how.cameras, topics=()) == CameraOptions()
    with contextlib.ExitStack() as stack:
        if as_they_are and all(map(_is_mcap, paths)):
            files = log_files(paths)
            size = sum(file.stat().st_size for file in files if isinstance(file, Path))
            check: Check = "data" if size <= AT_ONCE else "chunks"  # as `open_to_look`
            opened = (LogReader(open_store(file), check=check) for file in files)
            readers = [stack.enter_context(reader) for reader in opened]
            for line in (line for reader in readers for line in reader.warnings):
                how.warn(line)
            yield _logged_messages(readers, how.cameras.topics)
        else:
            yield _encoded_frames(stack.enter_context(opened_source(paths, how)))


def _is_mcap(path: Path) -> bool:
    return any(path.glob("*.mcap*")) if path.is_dir() else starts_as_log(path)


def _logged_messages(readers: Sequence[LogReader], wanted: Sequence[str]) -> Feed[DueMessage]:
    """The messages of MCAP files, bytes and times as they are; what two files tell is told once.

    Args:
        readers: of the files.
        wanted: topics that are played, or patterns of them; without any all.

    Raises:
        UsageError: there are no messages, or no such topic.
    """
    known = [_topics(reader) for reader in readers]
    path, there = readers[0].path, sorted({topic.name for one in known for topic in one.values()})
    for asked in wanted:
        if not any(fits_topic(name, asked) for name in there):
            raise UsageError(f"{path}: no topic {asked}; it has: {', '.join(there)}")
    if wanted:
        chosen = {name for name in there if any(fits_topic(name, asked) for asked in wanted)}
        known = [{n: t for n, t in one.items() if t.name in chosen} for one in known]
    segments = [s for reader in readers for s in reader.segments if s.size]
    if not segments and (cut := next((r for r in readers if r.missing), None)):
        raise LogDamagedError(f"{cut.path}: {cut.missing}: there is no message before")
    if not segments:
        raise UsageError(f"{path} has no messages: there is nothing to play")

    def messages() -> Iterator[DueMessage]:
        now, told = -1, set[DueMessage]()
        each = [_of_topics(reader, one) for reader, one in zip(readers, known, strict=True)]
        for message in heapq.merge(*each, key=lambda message: message.time_ns):
            if message.time_ns != now:
                now, told = message.time_ns, set()
            if message not in told:  # the ground truth is in every file of a recording
                told.add(message)
                yield message

    return Feed(
        start=min(segment.start for segment in segments),
        stop=max(segment.end for segment in segments),
        items=messages,
        topics=tuple(dict.fromkeys(topic for one in known for topic in one.values())),
    )


def _topics(reader: LogReader) -> dict[int, Topic]:
    topics = {}
    for number, channel in reader.channels.items():
        schema = reader.schemas.get(channel.schema_id)
        named = ("", "", b"") if schema is None else (schema.name, schema.encoding, schema.data)
        topics[number] = Topic(channel.topic, channel.encoding, *named)
    return topics


def _of_topics(reader: LogReader, known: dict[int, Topic]) -> Iterator[DueMessage]:
    for message in reader.messages():
        if message.channel.id in known:
            yield DueMessage(message.log_time, known[message.channel.id], message.data)


def _encoded_frames(source: Logged) -> Feed[DueMessage]:
    """The frames of a source as messages, as a recording of them would hold."""
    spec, frames = source.spec, frames_feed(source)
    encoders: list[Any] = [VectorEncoder() for _ in spec.streams]
    if spec.images:
        height, width = spec.frame_shape
        encoders = [ImageEncoder(height, width, name) for name in spec.streams]
    names = [view_topic(name) for name in spec.streams]
    if spec.truth:
        encoders.append(TruthEncoder(spec.truth))
        names.append(TRUTH_TOPIC)
    topics = [
        Topic(name, ENCODING, encoder.schema, ENCODING, encoder.schema_data())
        for name, encoder in zip(names, encoders, strict=True)
    ]

    def messages() -> Iterator[DueMessage]:
        for frame in frames.items():
            values = (*frame.shown, frame.truth)
            for topic, encode, value in zip(topics, encoders, values, strict=False):
                if value is not None:
                    yield DueMessage(frame.time_ns, topic, encode(frame.time_ns, value))

    return Feed(frames.start, frames.stop, messages, tuple(topics))


def frames_feed(source: Logged) -> Feed[Frame]:
    """Every frame of a source from its clock on, with what each stream shows at it."""
    spec, first = source.spec, source.t
    end = first + source.frames

    def frames() -> Iterator[Frame]:
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
                yield Frame(spec.time_ns(t), tuple(shown), truth)

    return Feed(spec.time_ns(first), spec.time_ns(end - 1), frames)
