"""Topics of messages, of MCAP logs and ROS bags alike, as streams of images or numbers."""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from cdmisfa.core.arrays import IntArray
from cdmisfa.core.errors import LogDamagedError, UsageError
from recorder.images.fields import EVERY, column_names, joints_of, number_paths, with_joints
from recorder.images.messages import (
    PACKED,
    SCHEMAS,
    MessageKind,
    decoder_of,
    message_decoder,
    options_for,
    packed_image,
    stamp_of,
    stated_format,
)
from recorder.images.options import NUMBERS_RECIPE, RECIPE, VIDEO_RECIPE, InputOptions
from recorder.images.pixels import Content, MalformedImage
from recorder.images.videos import VideoPackets
from recorder.mcap.records import MalformedRecord
from replay.logs.stream import BROKEN, LogStream, limited

Channel = TypeVar("Channel")

# Columns with one value of each joint.
_OF_JOINT: Final = re.compile(r"(position|velocity|effort)(?:\[(\d+)\])?$")


class NoTopicError(UsageError):
    """A log that has none of the topics that are asked for."""


def fits_topic(name: str, topics: Sequence[str]) -> bool:
    """Return whether a name is one of some topics, or matches a pattern among them."""
    return any(name == topic or fnmatch.fnmatchcase(name, topic) for topic in topics)


def check_topics(path: Path, name: str, topics: Sequence[str]) -> None:
    """Refuse topics of a log that has none, unless one is its name; a `NoTopicError`."""
    if topics and not fits_topic(name, topics):
        raise NoTopicError(f"{path}: this format has no topics; remove --topic {', '.join(topics)}")


def choose_topics(
    path: Path, channels: Iterable[tuple[str, MessageKind, Channel]], options: InputOptions
) -> list[tuple[str, MessageKind, list[Channel]]]:
    """Choose the topics that are asked for, of images or of fields, in their order in the log.

    A topic may have several channels of one kind, as where its publisher began again.

    Args:
        path: the log.
        channels: the topic, the kind of the messages, and the channel itself.
        options: `topics`, optional if there is only one, and whether images or fields are read.

    Returns:
        Topic, kind and channels of each.

    Raises:
        NoTopicError: there is none, or several and none is named.
        UsageError: its messages are of several kinds.
    """
    readable: dict[str, dict[MessageKind, tuple[MessageKind, list[Channel]]]] = {}
    unreadable: dict[str, str] = {}
    for topic, kind, channel in channels:
        how = options_for(topic, kind, options)
        if decoder_of(kind, how) is None:
            unreadable[topic] = f"{kind.schema} in {kind.encoding or 'no encoding'}"
        else:
            alike = kind if how.fields else MessageKind(kind.schema, kind.encoding)
            kinds = readable.setdefault(topic, {})
            kinds.setdefault(alike, (kind, []))[1].append(channel)
    topics = options.topics
    chosen = [topic for topic in readable if not topics or fits_topic(topic, topics)]
    if not chosen or (not topics and len(chosen) > 1):
        raise NoTopicError(f"{path}: {_why_none(readable, unreadable, options)}")
    if mixed := next((topic for topic in chosen if len(readable[topic]) > 1), None):
        listed = ", ".join(f"{kind.schema} in {kind.encoding}" for kind in readable[mixed])
        raise UsageError(f"{path}: {mixed} has messages of several types: {listed}")
    return [(topic, *next(iter(readable[topic].values()))) for topic in chosen]


def left_out(
    path: Path, topics: Iterable[str], chosen: Iterable[Sequence[Any]], options: InputOptions
) -> list[str]:
    """Return a note on the topics that are not chosen, unless topics are asked for."""
    absent = ", ".join(sorted({*topics} - {each[0] for each in chosen}))
    named = options.topics or options.fields or not absent
    return [] if named else [f"{path}: left out, unless named by --topic: {absent}"]


def _why_none(readable: Iterable[str], unreadable: Mapping[str, str], options: InputOptions) -> str:
    """Return the reason why no topic is chosen.

    Args:
        readable: topics that can be read.
        unreadable: types of the messages on all other topics.
        options: the requested topics.
    """
    what = "messages with fields" if options.fields else "images"
    if not readable and not any(topic in unreadable for topic in options.topics):
        if options.fields:
            return "it has no messages with known fields"
        return "it has no images; for numbers use --field"
    wrong = "choose one --topic or more"
    if topics := ", ".join(options.topics):
        kind = next((unreadable[topic] for topic in options.topics if topic in unreadable), "")
        images = f"{topics} has {kind}, which is not a supported image ({', '.join(SCHEMAS)})"
        wrong = images if kind and not options.fields else f"no topic {topics}"
    return f"{wrong}; it has {what} on: {', '.join(sorted(readable)) or 'none'}"


def message_stream(
    path: Path,
    topic: str,
    kind: MessageKind,
    options: InputOptions,
    times: IntArray,
    fetch: Callable[[int], Any],
    **about: Any,
) -> LogStream:
    """Make a stream of the messages on a topic.

    Args:
        path: the log.
        topic: the topic.
        kind: type of its messages.
        options: whether images or fields are read.
        times: log times in nanoseconds, in order.
        fetch: reads a message.
        about: further attributes of the stream.

    Raises:
        UsageError: there is no message, or no header if `options.stamp` asks for it.
        LogDamagedError: a message cannot be read.
    """
    options = options_for(topic, kind, options)
    warnings = list(about.pop("warnings", ()))
    if options.fields == EVERY:
        decode_whole = message_decoder(kind)
        try:
            first = bytes(fetch(0)) if len(times) else None
            paths = number_paths(decode_whole(first)) if decode_whole and first else EVERY
            options = replace(options, fields=tuple(paths))
        except (MalformedRecord, MalformedImage) as error:
            raise LogDamagedError(f"{path}: {topic}: {error}") from None
        if not options.fields:
            raise UsageError(f"{path}: {topic} has {kind.schema}, with neither images nor numbers")
        warnings.append(f"{path}: {topic} is read as its numbers {', '.join(options.fields)}")
    joints = _joints(path, kind, len(times), fetch) if options.fields else []
    ordered = partial(with_joints, f"{path}: {topic}", joints) if joints else None
    decode = decoder_of(kind, options, ordered)
    assert decode is not None

    def columns() -> list[str]:
        message, numbers = fetch(0), list[str]()
        for field in options.fields:
            read = decoder_of(kind, replace(options, fields=(field,)))
            numbers += column_names(field, len(read(message))) if read else []
        return numbers

    def named(column: re.Match[str]) -> str:
        joint = joints[int(column[2] or 0)]
        return joint if column[1] == "position" else f"{joint}.{column[1]}"

    names = kind.schema, kind.encoding
    is_packed = names in PACKED and not options.fields
    stream = LogStream(
        path=path,
        topic=topic,
        count=len(times),
        times=times,
        fetch=fetch,
        decode=decode,
        compressed=partial(packed_image, *names) if is_packed else None,
        stamp=stamp_of(kind) if options.stamp == "header" else None,
        pixel_format=partial(stated_format, *names),
        recipe=NUMBERS_RECIPE if options.fields else RECIPE,
        fields=options.fields,
        warnings=warnings,
        columns=columns,
        elements=lambda: [_OF_JOINT.sub(named, name) for name in columns()] if joints else (),
        **about,
    )
    if isinstance(decode, VideoPackets):
        stream = _Video(stream, decode).stream()
    return by_stamps(stream) if options.stamp == "header" else stream


def _joints(
    path: Path, kind: MessageKind, count: int, fetch: Callable[[int], Any]
) -> Sequence[str]:
    """Return the joints of the first JointState message that is readable; [] without names."""
    decode = message_decoder(kind) if kind.schema.endswith("JointState") else None
    for row in range(count if decode else 0):
        with suppress(*BROKEN), limited(path, "its decoder"):
            assert decode is not None
            joints = joints_of(decode(bytes(fetch(row))))
            return joints if len({*joints}) == len(joints) else []
    return []


def by_stamps(stream: LogStream) -> LogStream:
    """Return a stream in the order and at the times that its messages state; all are read.

    Raises:
        UsageError: the messages state no times.
        LogDamagedError: a message cannot be read.
    """
    stamps = np.zeros(stream.count, np.int64)
    stamp = stream.stamp or (lambda stored: 0)
    for row in range(stream.count):
        try:
            stamps[row] = stream.taken(row, stamp)
        except (MalformedRecord, MalformedImage) as error:
            raise LogDamagedError(f"{stream.name_of(row)}: {error}") from None
        except OverflowError:
            raise LogDamagedError(
                f"{stream.name_of(row)}: the time in its header is too large: remove "
                "--set input.stamp=header"
            ) from None
    if stream.stamp is None or (len(stamps) > 1 and stamps.min() == stamps.max()):
        raise UsageError(
            f"{stream.path}: the headers on {stream.topic} have no times: remove "
            "--set input.stamp=header"
        )
    order = np.argsort(stamps, kind="stable")
    return stream.part(order, stamps[order])


class _Video:
    """Images of a video in messages, in any order, from the first on that needs none before it.

    Args:
        messages: the messages.
        packets: their decoder.
    """

    def __init__(self, messages: LogStream, packets: VideoPackets) -> None:
        self._messages, self._packets = messages, packets
        self._next = -1  # the message that the decoder expects
        self._broken: dict[int, MalformedImage | MalformedRecord] = {}

    def stream(self) -> LogStream:
        """Return the images as a stream; a UsageError if none can be decoded."""
        messages = self._messages
        rows = range(messages.count)
        self._first = first = next((row for row in rows if self._begins(row)), messages.count)
        if first == messages.count:
            why = "the video has no key frame, so no image can be decoded"
            try:
                messages.taken(0, self._packets.begins)
            except (MalformedImage, MalformedRecord) as error:
                why = str(error)
            raise UsageError(f"{messages.path}: {messages.topic}: {why}")
        stamp = messages.stamp
        lost = f"{messages.path}: {first} images before the first key frame are skipped"
        video = replace(
            messages,
            fetch=int,
            decode=self._decode,
            pixel_format=None,
            stamp=stamp and (lambda row: messages.taken(row, stamp)),
            recipe=VIDEO_RECIPE,
            warnings=[*messages.warnings, *([lost] if first else [])],
        )
        assert messages.times is not None
        return video.part(np.arange(first, messages.count), messages.times[first:])

    def _decode(self, row: int) -> Content:
        start = row
        while start not in (self._first, self._next) and not self._begins(start):
            start -= 1
            if start in self._broken:  # the images behind it are made of it
                raise self._broken[start]
        if start != self._next:
            self._packets.forget()
        self._next = -1
        for at in range(start, row + 1):
            try:
                image = self._packets(self._messages.fetch(at))
            except (MalformedImage, MalformedRecord) as error:
                self._broken[at] = error
                raise
        self._next = row + 1
        return image

    def _begins(self, row: int) -> bool:
        try:
            return self._messages.taken(row, self._packets.begins)
        except (MalformedImage, MalformedRecord):
            return False
