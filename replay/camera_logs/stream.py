"""Streams of images: their interface, the choice of a topic, and errors in one line."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import ByteArray
from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from cdmisfa.core.untrusted import BUDGET, budget
from recorder.images.compressed import AT_ONCE, compressed_image
from recorder.images.messages import (
    PACKED,
    SCHEMAS,
    Decoder,
    MessageKind,
    Stamp,
    decoder_of,
    packed_picture,
    stamp_of,
    stated_format,
)
from recorder.images.options import RECIPE, InputOptions
from recorder.images.pixels import Shown
from recorder.log.messages import VECTOR_SCHEMA


class UnreadableError(LogDamagedError):
    """A library cannot read a file."""


LAST_NS: Final = 2**62
"""Log times from here on are beyond any clock, in nanoseconds."""

Found = TypeVar("Found")


@dataclass(frozen=True, slots=True)
class ChannelFacts:
    """What a log states of one topic.

    Attributes:
        topic: its name, or what stands for it.
        encoding: of its messages: "cdr", "ros1", the codec of a video, "png".
        schema: type of its messages.
        messages: how many there are.
        start_ns: time of the first, nanoseconds; None where it is not known.
        end_ns: time of the last.
        images: whether they are images that are read.
        missing: what the file that they are in lacks, as it was cut, in words.
        remarks: what its format cannot tell of it.
    """

    topic: str
    encoding: str
    schema: str
    messages: int
    start_ns: int | None = None
    end_ns: int | None = None
    images: bool = True
    missing: str = ""
    remarks: tuple[str, ...] = ()


class ImageStream(ABC):
    """The images of one camera, or the numbers of one topic, in the order of time.

    Attributes:
        path: the log or the folder they are in.
        topic: the topic, or what stands for it.
        times: (n,) uint64, when each was taken, in nanoseconds; empty where that is not known,
            in which case they are `count` images at any even rate.
        encoding: how its images are stored, where they are no messages of a log.
        recipe: how an image becomes a frame, for the record.
        fields: the numbers that are taken instead of images, in their order.
        warnings: what the user should know: what was cut or left out.
        remarks: what its format cannot tell of it, for who asks whether it is whole.
        missing: what a file that was cut lacks, in words, which is a warning, too; "" for others.
        told_rounded: whether warnings say of every number that is held rounded.
        decode: what makes an image of a message; None where they are no messages of a log.
    """

    path: Path
    topic: str
    times: NDArray[np.uint64]
    encoding: str = ""
    recipe: str = RECIPE
    fields: Sequence[str] = ()
    warnings: Sequence[str] = ()
    remarks: Sequence[str] = ()
    missing: str = ""
    told_rounded: bool = False
    decode: Decoder | None = None

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self.times)

    @property
    def logs(self) -> Sequence[ImageStream]:
        """The streams of single logs that it is made of."""
        return (self,)

    @abstractmethod
    def image(self, row: int) -> Shown:
        """Decode an image, gray and of its own size, (height, width) uint8; or numbers.

        Raises:
            MalformedRecord: it is no image that is read.
            LogDamagedError: the log is damaged there.
        """

    def begin(self, row: int, threads: Executor) -> Future[ByteArray] | None:
        """Begin to decode a picture that is asked for soon; None of what cannot be."""
        return None

    def taken(self, row: int, take: Callable[[Any], Found]) -> Found:
        """Apply a function to the bytes of a message; raises as `image`."""
        raise NotImplementedError

    def stamp(self, row: int) -> int:
        """When an image was made, as its message says, nanoseconds.

        Raises:
            UsageError: it is in no message, or this states no time.
            MalformedRecord, LogDamagedError: as for `image`.
        """
        raise UsageError(
            f"{self.path}: {self.topic} is no topic of messages: leave out input.stamp"
        )

    def pixels(self) -> str | None:
        """The format of pixels that the message of its first image states, "" of none.

        None where that message is broken; raises as `image`.
        """
        return ""

    def where(self, row: int) -> str:
        """How an error names an image."""
        return f"{self.path}: {self.topic} at {self.times[row]} ns"

    def close(self) -> None:  # noqa: B027 - some keep no file open
        """Let go of the files; harmless when called twice."""


def begun(threads: Executor, data: bytes, *, color: bool) -> Future[ByteArray]:
    """Begin to decode a JPEG or PNG."""
    return threads.submit(compressed_image, data, color=color, most=AT_ONCE)


class MessageImages(ImageStream):
    """The images, or the numbers, in the messages on one topic of a log.

    Attributes:
        kind: of the messages.
        color: whether colours are taken as they are.
    """

    kind: MessageKind
    color: bool
    decode: Decoder

    @abstractmethod
    def taken(self, row: int, take: Callable[[Any], Found]) -> Found: ...

    def image(self, row: int) -> Shown:
        return self.taken(row, self.decode)

    def begin(self, row: int, threads: Executor) -> Future[ByteArray] | None:
        kind = self.kind.schema, self.kind.encoding
        if kind not in PACKED or self.fields:
            return None
        try:
            data = self.taken(row, partial(packed_picture, *kind))
        except CdmisfaError:
            return None
        return None if data is None else begun(threads, data, color=self.color)

    def pixels(self) -> str | None:
        return self.taken(0, partial(stated_format, self.kind.schema, self.kind.encoding))

    def stamp(self, row: int) -> int:
        if self._stamp is None:
            raise UsageError(
                f"{self.path}: messages on {self.topic} have no header: leave out "
                "input.stamp=header"
            )
        return self.taken(row, self._stamp)

    @cached_property
    def _stamp(self) -> Stamp | None:
        return stamp_of(self.kind)


def choose_images(
    path: Path,
    topic: str | None,
    channels: Iterable[tuple[str, MessageKind, Found]],
    reading: InputOptions,
) -> tuple[list[Found], Decoder]:
    """Choose the channels of a topic, of images or of fields, and the decoder of their messages.

    They are of one topic and of one kind, as where its publisher began again.

    Args:
        path: the log, for the error.
        topic: as the user named it, or None.
        channels: topic, kind of the messages, and what stands for the channel.
        reading: what is taken of them.

    Raises:
        UsageError: there is none, or not one topic, or its messages are of several kinds.
    """
    readable: dict[str, dict[MessageKind, tuple[list[Found], Decoder]]] = {}
    others: dict[str, str] = {}
    for name, kind, channel in channels:
        decoder = decoder_of(kind, reading)
        if decoder is None:
            others[name] = f"{kind.schema} in {kind.encoding or 'no encoding'}"
        else:
            alike = kind if reading.fields else MessageKind(kind.schema, kind.encoding)
            kinds = readable.setdefault(name, {})
            kinds.setdefault(alike, ([], decoder))[0].append(channel)
    found = [name for name in readable if topic in (None, name)]
    if len(found) == 1:
        kinds = readable[found[0]]
        if len(kinds) > 1:
            said = ", ".join(f"{kind.schema} in {kind.encoding}" for kind in kinds)
            raise UsageError(
                f"{path}: {found[0]} holds messages of {len(kinds)} kinds, which are no one "
                f"stream: {said}"
            )
        return next(iter(kinds.values()))
    known = ", ".join(sorted(readable)) or "none"
    what = "messages with fields" if reading.fields else "images"
    if not readable and any(said.startswith(VECTOR_SCHEMA) for said in others.values()):
        raise UsageError(
            f"{path}: it is a recording of values, not of images: learn, view, export and play "
            "take it without options of images; to convert it, name them with --field values"
        )
    if topic is None:
        several = f"{path}: name one --topic or more; it has {what} on: {known}"
        raise UsageError(several if readable else holds_none(path, reading))
    if topic in others:
        images = ", ".join(SCHEMAS)
        why = f"which is no image: numbers are taken with --field; images are {images}"
        why = "whose fields are not known" if reading.fields else why
        raise UsageError(f"{path}: {topic} holds {others[topic]}, {why}")
    raise UsageError(f"{path}: no topic {topic}; it has {what} on: {known}")


class NothingLoggedError(LogDamagedError):
    """A log that was cut before its first message."""


def holds_none(path: Path, reading: InputOptions) -> str:
    """The error text for a log without images, or without fields."""
    if reading.fields:
        return f"{path}: it holds no messages whose fields are known"
    return f"{path}: it holds no images; numbers are taken with --field"


def sorted_times(where: str, times: Sequence[int] | NDArray[np.integer[Any]]) -> NDArray[np.uint64]:
    """The times of a stream in their order, (n,) nanoseconds, as every stream holds them.

    Args:
        where: what has them, for the error.
        times: one at least, nanoseconds.

    Raises:
        LogDamagedError: a time lies before 1970, or beyond any clock.
    """
    if times[0] < 0 or times[-1] >= LAST_NS:
        raise LogDamagedError(f"{where} has times beyond any clock")
    return np.asarray(times, np.uint64)


@contextmanager
def explained(path: Path, program: str, *, held: int = 0, remedy: str = "") -> Iterator[None]:
    """Turn any error of a library that reads a file into one line, within a memory budget.

    Args:
        path: what is read.
        program: the library.
        held: bytes of the memory that it may take which are taken already.
        remedy: what to do where it takes more.

    Raises:
        UnreadableError: it raised, or would take more memory.
    """
    with in_one_line(path, program, remedy), budget(max(BUDGET - held, 0)):
        yield


@contextmanager
def arrow_explained(path: Path, *, held: int = 0, remedy: str = "") -> Iterator[None]:
    """As `explained`, for PyArrow, whose memory is then the system's, which the budget counts.

    What its own pool has in reserve has no budget.
    """
    import pyarrow

    pyarrow.set_memory_pool(pyarrow.system_memory_pool())
    with explained(path, "PyArrow", held=held, remedy=remedy):
        yield


@contextmanager
def in_one_line(path: Path, program: str, remedy: str = "") -> Iterator[None]:
    """Turn any error of a library that reads a file into one line.

    Raises:
        UnreadableError: instead of each that is no CdmisfaError.
    """
    try:
        yield
    except CdmisfaError:
        raise
    except MemoryError:
        most = f"{BUDGET >> 20} MiB of memory for it, the limit"
        said = f"{path}: {program} takes more than {most}"
        raise UnreadableError(f"{said}: {remedy}" if remedy else said) from None
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise UnreadableError(f"{path}: {program} cannot read it ({reason})") from None
