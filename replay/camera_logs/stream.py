"""What a stream of images is, and which topic of a log it is."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from replay.camera_logs.messages import SCHEMAS, Decoder, image_decoder
from replay.mcap.records import Bytes
from replay.storage.location import Location

LAST_NS: Final = 2**62
"""Log times from here on are beyond any clock, in nanoseconds."""

Found = TypeVar("Found")


class ImageStream(Protocol):
    """The images of one camera, in the order of time.

    Attributes:
        times: (n,) uint64, when each was taken, in nanoseconds; empty where nobody knows,
            in which case they are `count` images at any even rate.
        count: how many there are.
        topic: the topic, or what stands for it.
        recipe: how an image becomes a frame, for the record.
        warnings: what the user should know: what was cut or left out.
    """

    recipe: str
    times: NDArray[np.uint64]
    count: int
    topic: str
    warnings: Sequence[str]

    @property
    def path(self) -> Location:
        """The log or the folder they are in."""

    def frame(self, row: int) -> Bytes:
        """Decode an image into a frame, (height, width) uint8.

        Raises:
            LogDamagedError: it is no image that is read.
        """

    def close(self) -> None:
        """Let go of the files; harmless when called twice."""


def choose_images(
    path: Location, topic: str | None, channels: Iterable[tuple[str, str, str, Found]]
) -> tuple[Found, Decoder]:
    """Find the one channel of images that is meant, and the decoder of its messages.

    Args:
        path: the log, for the error.
        topic: as the user named it, or None.
        channels: topic, schema, encoding, and what stands for the channel.

    Raises:
        UsageError: there is none, or not one.
    """
    readable: list[tuple[str, Found, Decoder]] = []
    others: dict[str, str] = {}
    for name, schema, encoding, channel in channels:
        decoder = image_decoder(schema, encoding)
        if decoder is None:
            others[name] = f"{schema} in {encoding or 'no encoding'}"
        else:
            readable.append((name, channel, decoder))
    found = [(channel, decoder) for name, channel, decoder in readable if topic in (None, name)]
    if len(found) == 1:
        return found[0]
    known = ", ".join(sorted({name for name, _, _ in readable})) or "none"
    if topic is None:
        raise UsageError(f"{path}: name one --topic; it has images on: {known}")
    if len(found) > 1:
        raise UsageError(f"{path}: {len(found)} channels share the topic {topic}")
    if topic in others:
        raise UsageError(f"{path}: {topic} holds {others[topic]}, images are {', '.join(SCHEMAS)}")
    raise UsageError(f"{path}: no topic {topic}; it has images on: {known}")


def sorted_times(where: str, times: Sequence[int] | NDArray[np.uint64]) -> NDArray[np.uint64]:
    """The times of a stream in their order, as every stream holds them.

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
def explained(path: Path, program: str) -> Iterator[None]:
    """Say in one line what a library that lets any exception through cannot read."""
    try:
        yield
    except (CdmisfaError, MemoryError):
        raise
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise LogDamagedError(f"{path}: {program} cannot read it ({reason})") from None
