"""Where the images of other people's cameras lie: logs, bags, videos, folders of pictures."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from replay.camera_logs.pixels import (
    RECIPE,
    SCHEMAS,
    Decoder,
    compressed_gray,
    image_decoder,
    shrink,
)
from replay.mcap.identity import identity
from replay.mcap.reader import LogReader
from replay.mcap.records import Bytes, Channel, MalformedRecord
from replay.mcap.segments import Segment
from replay.storage.checksum import sha256
from replay.storage.listing import log_files
from replay.storage.location import Location, Url, location

CACHE_BYTES: Final = 1024 * 1024
PICTURES: Final = (".jpeg", ".jpg", ".png")
BAGS: Final = (".bag", ".db3")
VIDEOS: Final = (".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".webm", ".wmv")

Found = TypeVar("Found")


class ImageStream(Protocol):
    """The images of one camera, in the order of time.

    Attributes:
        times: (n,) uint64, when each was taken, in nanoseconds; empty where nobody knows,
            in which case they are `count` images at any even rate.
        count: how many there are.
        recipe: how an image becomes a frame, for the record.
    """

    recipe: str
    times: NDArray[np.uint64]
    count: int

    @property
    def path(self) -> Location:
        """The log or the folder they are in."""

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
    path: Location, topic: str | None, size: tuple[int, int], *, salvage: bool = False
) -> ImageStream:
    """Open the images on a topic of a log, or in a folder.

    Args:
        path: an MCAP log or its URL, a ROS bag, a video or a folder of pictures.
        topic: the topic; may be left out where there is one topic of images.
        size: (height, width) of a frame.
        salvage: leave out what is damaged.

    Raises:
        UsageError: no such topic, or no images on it.
        LogDamagedError: the log is damaged.
    """
    if isinstance(path, Url):
        return McapImages(path, topic, size, salvage=salvage)
    if _is_bag(path):
        from replay.camera_logs.bag import BagImages

        return BagImages(path, topic, size)
    if is_split(path):
        from replay.camera_logs.joined import open_joined

        return open_joined(path, parts_of(path), topic, size, salvage=salvage)
    if path.is_dir():
        return FolderImages(path, topic, size)
    if path.suffix.lower() in VIDEOS:
        from replay.camera_logs.video import VideoImages

        return VideoImages(path, topic, size)
    return McapImages(path, topic, size, salvage=salvage)


def image_logs(paths: Sequence[str | Location]) -> list[Location]:
    """List the logs that paths mean: a folder of MCAP files is each of them, a rosbag2 one log.

    Raises:
        UsageError: there is none.
    """
    found: list[Location] = []
    for path in map(location, paths):
        if only_foreign(path) or (isinstance(path, Path) and is_split(path)):
            found.append(path)
        else:
            found += log_files(path)
    return found


def only_foreign(path: Location) -> bool:
    """Whether a path can be no recording of ours, by its kind."""
    if isinstance(path, Url):
        return False
    video = path.suffix.lower() in VIDEOS and path.is_file()
    return video or _is_bag(path) or _is_picture_folder(path)


def is_split(path: Path) -> bool:
    """Whether a folder is a rosbag2 of MCAP files, which are parts of one log."""
    return (path / "metadata.yaml").is_file() and any(path.glob("*.mcap"))


def parts_of(folder: Path) -> list[Path]:
    """The parts of a rosbag2, in order."""
    return sorted(folder.glob("*.mcap"), key=_by_number)


def fingerprint(path: Location, streams: Sequence[ImageStream]) -> dict[str, Any]:
    """What tells a log from others: see `identity`; of a folder, names and contents count.

    Args:
        path: the log.
        streams: of which one reads it, where it is behind a URL.

    Raises:
        CdmisfaError: a file cannot be read.
    """
    if isinstance(path, Url) or not path.is_dir():
        reads = (s.reader for s in streams if isinstance(s, McapImages) and s.path == path)
        return identity(path, next(reads, None))
    whole = hashlib.sha256()
    for file in sorted(p for p in path.iterdir() if p.is_file()):
        whole.update(f"{file.name}\0{sha256(file)}\n".encode("utf-8", "surrogateescape"))
    return {"file": path.name, "sha256": whole.hexdigest()}


def _is_bag(path: Path) -> bool:
    """A ROS bag that is not in MCAP files."""
    if path.is_dir():
        return (path / "metadata.yaml").exists() and not any(path.glob("*.mcap"))
    return path.suffix in BAGS


def _is_picture_folder(path: Path) -> bool:
    return (
        path.is_dir()
        and not any(path.glob("*.mcap*"))
        and any(p.suffix.lower() in PICTURES for p in path.iterdir())
    )


def choose_topic(
    path: Location, topic: str | None, readable: Sequence[tuple[str, Found]], others: dict[str, str]
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

    recipe = RECIPE

    def __init__(
        self, path: Location, topic: str | None, size: tuple[int, int], *, salvage: bool = False
    ) -> None:
        self.path = path
        self.size = size
        self.reader = LogReader(path, salvage=salvage, cache_bytes=CACHE_BYTES)
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
        try:
            return shrink(self._decode(self._payload(row)), *self.size)
        except MalformedRecord as error:
            raise LogDamagedError(
                f"{self.path}: {self.topic} at {self.times[row]} ns: {error}"
            ) from None

    def close(self) -> None:
        """Let go of the file; harmless when called twice."""
        self.reader.close()

    def _payload(self, row: int) -> bytes:
        table = self.reader.table(self._segments[int(self._segment_of[row])])
        if table is None:
            raise MalformedRecord("it is damaged")
        place = int(self._row_in[row])
        if self.reader.by_index:
            own = np.flatnonzero(table.channel == self.channel.id)
            if place >= len(own) or table.log_time[own[place]] != self.times[row]:
                raise MalformedRecord("its chunk holds other messages than the summary names")
            place = int(own[place])
        return table.payload(place)

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
        """Find every message of the topic.

        One pass over a log checks all of it; of a URL only its message indexes are read, and
        each chunk is checked when its images are.
        """
        self._segments: list[Segment] = []
        times, members, rows = [], [], []
        found = self._by_index() if self.reader.by_index else self._by_pass()
        for segment, log_times, places in found:
            times.append(log_times)
            members.append(np.full(len(places), len(self._segments), np.int32))
            rows.append(places.astype(np.int32))
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
        self.reader.expect(self._segments)

    def _by_pass(self) -> Iterator[tuple[Segment, NDArray[np.uint64], NDArray[np.intp]]]:
        """Log times of the topic's messages in each chunk, and their rows in its table."""
        for segment, table in self.reader.tables(ordered=False):
            own = np.flatnonzero(table.channel == self.channel.id)
            if len(own):
                yield segment, table.log_time[own], own

    def _by_index(self) -> Iterator[tuple[Segment, NDArray[np.uint64], NDArray[np.intp]]]:
        """As `_by_pass`, with their rows among the topic's own messages of the chunk."""
        number = self.channel.id
        segments = [s for s in self.reader.segments if (s.channel_counts() or {}).get(number)]
        self.reader.expect(segments, indexes=True)
        for segment in segments:
            pairs = np.concatenate([p for c, p in self.reader.index(segment) if c == number])
            pairs = pairs[np.argsort(pairs[:, 1], kind="stable")]
            yield segment, pairs[:, 0], np.arange(len(pairs))


class FolderImages:
    """The pictures of a folder, in the order of their names, numbers by value.

    Args:
        path: the folder.
        topic: its name, or None.
        size: (height, width) of a frame.

    Raises:
        UsageError: it is no topic of the folder.
    """

    recipe = RECIPE

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
