"""Where the images of other people's cameras lie: logs, bags, folders of pictures."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from cdmisfa.blocks import NANOSECONDS
from cdmisfa.errors import CdmisfaError, LogDamagedError, UsageError
from replay.files import log_files, sha256
from replay.images import SCHEMAS, Decoder, compressed_gray, image_decoder, shrink
from replay.reader import LogReader
from replay.records import Bytes, Channel, MalformedRecord
from replay.structure import Segment

CACHE_BYTES: Final = 1024 * 1024
PICTURES: Final = (".jpeg", ".jpg", ".png")
BAGS: Final = (".bag", ".db3")

Found = TypeVar("Found")


class ImageStream(Protocol):
    """The images of one camera, in the order of time.

    Attributes:
        path: the log or the folder they are in.
        times: (n,) uint64, when each was taken, in nanoseconds; empty where nobody knows,
            in which case they are `count` images at any even rate.
        count: how many there are.
    """

    path: Path
    times: NDArray[np.uint64]
    count: int

    @property
    def topic(self) -> str:
        """The topic, or what stands for it."""

    @property
    def warnings(self) -> Sequence[str]:
        """What the user should know: what was cut or left out."""

    def frame(self, row: int) -> Bytes:
        """Decode an image into a frame, (height, width) uint8.

        Raises:
            LogDamagedError: it is no image that is read.
        """

    def close(self) -> None:
        """Let go of the files; harmless when called twice."""


def open_images(
    path: Path, topic: str | None, size: tuple[int, int], *, salvage: bool = False
) -> ImageStream:
    """Open the images on a topic of a log, or in a folder.

    Args:
        path: an MCAP log, a ROS bag or a folder of pictures.
        topic: the topic; may be left out where there is one topic of images.
        size: (height, width) of a frame.
        salvage: leave out what is damaged.

    Raises:
        UsageError: no such topic, or no images on it.
        LogDamagedError: the log is damaged.
    """
    if _is_bag(path):
        from replay.bags import BagImages

        return BagImages(path, topic, size)
    if path.is_dir():
        return FolderImages(path, topic, size)
    return McapImages(path, topic, size, salvage=salvage)


def image_logs(paths: Sequence[Path]) -> list[Path]:
    """List the logs that paths mean: a folder of MCAP files is each of them.

    Raises:
        UsageError: there is none.
    """
    found: list[Path] = []
    for path in paths:
        if _is_bag(path) or _is_picture_folder(path):
            found.append(path)
        else:
            found += log_files(path)
    return found


def only_foreign(path: Path) -> bool:
    """Whether a path can be no recording of ours, by its kind."""
    return _is_bag(path) or _is_picture_folder(path)


def fingerprint(path: Path) -> str:
    """SHA-256 of a file, or over the names and contents of a folder's files.

    Raises:
        CdmisfaError: a file cannot be read.
    """
    if not path.is_dir():
        return sha256(path)
    whole = hashlib.sha256()
    for file in sorted(p for p in path.iterdir() if p.is_file()):
        whole.update(f"{file.name}\0{sha256(file)}\n".encode("utf-8", "surrogateescape"))
    return whole.hexdigest()


def _is_bag(path: Path) -> bool:
    """A ROS bag; one in a single MCAP file is read as that."""
    if path.is_dir():
        return (path / "metadata.yaml").exists() and len(list(path.glob("*.mcap"))) != 1
    return path.suffix in BAGS


def _is_picture_folder(path: Path) -> bool:
    return (
        path.is_dir()
        and not any(path.glob("*.mcap*"))
        and any(p.suffix.lower() in PICTURES for p in path.iterdir())
    )


def choose_topic(
    path: Path, topic: str | None, readable: Sequence[tuple[str, Found]], others: dict[str, str]
) -> Found:
    """Find the one channel of images that is meant.

    Args:
        path: the log, for the error.
        topic: as the user named it, or None.
        readable: topic and channel of each channel of images.
        others: for every other topic, what it holds.

    Raises:
        UsageError: there is none, or not one.
    """
    found = [channel for name, channel in readable if topic in (None, name)]
    if len(found) == 1:
        return found[0]
    known = ", ".join(sorted({name for name, _ in readable})) or "none"
    if topic is None:
        raise UsageError(f"{path}: name one --topic; it has images on: {known}")
    if len(found) > 1:
        raise UsageError(f"{path}: {len(found)} channels share the topic {topic}")
    if topic in others:
        raise UsageError(f"{path}: {topic} holds {others[topic]}, images are {', '.join(SCHEMAS)}")
    raise UsageError(f"{path}: no topic {topic}; it has images on: {known}")


class McapImages:
    """The images on one topic of one log, in the order of log time.

    Args:
        path: the log.
        topic: the topic; may be left out where the log has one topic of images.
        size: (height, width) of a frame.
        salvage: leave out what is damaged.

    Raises:
        UsageError: no such topic, or no images on it.
        LogDamagedError: the log is damaged.
    """

    def __init__(
        self, path: Path, topic: str | None, size: tuple[int, int], *, salvage: bool = False
    ) -> None:
        self.path = path
        self.size = size
        self.reader = LogReader(path, salvage=salvage, cache_bytes=CACHE_BYTES)
        self._last: tuple[int, Bytes] | None = None
        self.count = 0
        try:
            self.channel, self._decode = self._find(topic)
            self._index()
        except BaseException:
            self.reader.close()
            raise

    @property
    def topic(self) -> str:
        """The topic."""
        return self.channel.topic

    @property
    def warnings(self) -> Sequence[str]:
        """What was cut off or left out."""
        problems = [f"{p.where}: {p.what}" for p in self.reader.problems]
        return [f"{self.path}: {text}" for text in (self.reader.missing, *problems) if text]

    def frame(self, row: int) -> Bytes:
        """Decode a message into a frame, (height, width) uint8.

        Raises:
            LogDamagedError: the message is no image that is read.
        """
        if self._last is not None and self._last[0] == row:
            return self._last[1]
        segment = self._segments[int(self._segment_of[row])]
        table = self.reader.table(segment)
        try:
            if table is None:
                raise MalformedRecord("it is damaged")
            image = shrink(self._decode(table.payload(int(self._row_in[row]))), *self.size)
        except MalformedRecord as error:
            raise LogDamagedError(
                f"{self.path}: {self.topic} at {self.times[row]} ns: {error}"
            ) from None
        self._last = (row, image)
        return image

    def close(self) -> None:
        """Let go of the file; harmless when called twice."""
        self.reader.close()

    def _find(self, topic: str | None) -> tuple[Channel, Decoder]:
        readable: list[tuple[str, tuple[Channel, Decoder]]] = []
        others: dict[str, str] = {}
        for channel in self.reader.channels.values():
            schema = self.reader.schemas.get(channel.schema_id)
            name = schema.name if schema else "no schema"
            decoder = image_decoder(name, channel.encoding)
            if decoder is None:
                others[channel.topic] = f"{name} in {channel.encoding or 'no encoding'}"
            else:
                readable.append((channel.topic, (channel, decoder)))
        return choose_topic(self.path, topic, readable, others)

    def _index(self) -> None:
        """Find every message of the topic; one pass over the log checks all of it."""
        self._segments: list[Segment] = []
        times, members, rows = [], [], []
        for segment, table in self.reader.tables(ordered=False):
            own = np.flatnonzero(table.channel == self.channel.id)
            if len(own):
                times.append(table.log_time[own])
                members.append(np.full(len(own), len(self._segments), np.int32))
                rows.append(own.astype(np.int32))
                self._segments.append(segment)
        if not times:
            raise UsageError(f"{self.path}: there is no message on {self.channel.topic}")
        order = np.argsort(np.concatenate(times), kind="stable")
        self.times = np.concatenate(times)[order]
        if int(self.times[-1]) >= 2**62:
            raise LogDamagedError(f"{self.path}: {self.channel.topic} has times beyond any clock")
        self._segment_of = np.concatenate(members)[order]
        self._row_in = np.concatenate(rows)[order]
        self.count = len(order)


class FolderImages:
    """The pictures of a folder, in the order of their names, numbers by value.

    Args:
        path: the folder.
        topic: its name, or None.
        size: (height, width) of a frame.

    Raises:
        UsageError: it is no topic of the folder.
    """

    def __init__(self, path: Path, topic: str | None, size: tuple[int, int]) -> None:
        self.path = path
        self._size = size
        if topic not in (None, self.topic):
            raise UsageError(f"{path}: a folder of pictures has no topics, leave {topic} out")
        self._files = sorted(
            (p for p in path.iterdir() if p.suffix.lower() in PICTURES), key=_by_number
        )
        self.count = len(self._files)
        self.times = np.empty(0, np.uint64)

    @property
    def topic(self) -> str:
        """The folder's name."""
        return self.path.resolve().name

    @property
    def warnings(self) -> Sequence[str]:
        """Nothing: a picture is there or not."""
        return ()

    def frame(self, row: int) -> Bytes:
        """Decode a picture into a frame, (height, width) uint8.

        Raises:
            LogDamagedError: it is no picture that is read.
            CdmisfaError: it cannot be opened.
        """
        file = self._files[row]
        try:
            return shrink(compressed_gray(file.read_bytes()), *self._size)
        except MalformedRecord as error:
            raise LogDamagedError(f"{file}: {error}") from None
        except OSError as error:
            raise CdmisfaError(f"{file}: {error.strerror}") from None

    def close(self) -> None:
        """Do nothing: no file stays open."""


def even_times(count: int, fps: float) -> NDArray[np.uint64]:
    """Times of images of which only the rate is known, from 0, in nanoseconds."""
    times: NDArray[np.uint64] = np.rint(np.arange(count) * NANOSECONDS / fps).astype(np.uint64)
    return times


def _by_number(path: Path) -> list[tuple[int, str]]:
    """Sort key that puts 9.png before 10.png."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(p) if p.isdecimal() else -1, p) for p in parts]
