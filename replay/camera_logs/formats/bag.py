"""ROS bags: the images, or numbers, of a rosbag2 (.db3) or of a ROS 1 .bag, through rosbags."""

from __future__ import annotations

import bz2
import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeVar

import lz4.frame
import numpy as np

from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from recorder.images.decoding import IMAGES, MessageKind, Reading, Taken, decoder_of
from recorder.images.fields import NUMBERS_RECIPE
from recorder.mcap.records import MAX_CHUNK
from replay.camera_logs.formats.bag_folder import plain_bag, unpacked_message
from replay.camera_logs.stream import (
    ChannelFacts,
    MessageImages,
    choose_images,
    explained,
    sorted_times,
)

BAGS: Final = (".bag", ".db3")

Found = TypeVar("Found")


class BagImages(MessageImages):
    """The images, or the numbers, on a topic of a .bag, .db3 or rosbag2's folder, by stamps.

    Raises:
        CdmisfaError: the package rosbags is missing.
        UsageError: no such topic, or no images on it.
        LogDamagedError: rosbags cannot read it.
    """

    def __init__(self, path: Path, topic: str | None, *, reading: Reading = IMAGES) -> None:
        self.path = path
        if reading.fields:
            self.recipe, self.fields = NUMBERS_RECIPE, reading.fields
        self._messages: Iterator[tuple[int, bytes]] = iter(())
        self._next = -1
        self._ros1 = _is_ros1(path)
        self._opened = contextlib.ExitStack()
        try:
            self._reader, self._packed = self._opened.enter_context(_opened(path))
            self._connections, self.decode = self._find(topic, reading)
            self.topic = str(self._connections[0].topic)
            with explained(path, "rosbags"):
                stamps = list(self._stamps())
            if not stamps:
                raise UsageError(f"{path}: there is no message on {self.topic}")
            self.times = sorted_times(f"{path}: {self.topic}", stamps)
        except BaseException:
            self.close()
            raise
        self.warnings = [f"{path}: a ROS bag has no checksums, damaged pixels would go unnoticed"]

    def taken(self, row: int, take: Callable[[bytes], Found]) -> Found:
        return take(self._message(row))

    def _message(self, row: int) -> bytes:
        with explained(self.path, "rosbags"):
            if row != self._next:
                self._messages = self._from(int(self.times[row]))
                self._next = int(np.searchsorted(self.times, self.times[row]))
            while self._next <= row:
                _, data = next(self._messages, (0, b""))
                self._next += 1
            if self._packed:
                data = unpacked_message(data)
        return data

    def close(self) -> None:
        self._messages = iter(())
        self._opened.close()

    def _stamps(self) -> Iterator[int]:
        """The times of its messages in their order; of a database without reading their data."""
        if self._ros1:
            messages = self._reader.messages(self._connections)
            kept = ((stamp, isinstance(data, bytes)) for _, stamp, data in messages)
        else:
            topics = [c.topic for c in self._connections]
            kept = (
                (stamp, kind == "blob")  # SQLite keeps anything in any column
                for _, stamp, kind in _rows(
                    self._reader, "messages.timestamp, typeof(messages.data)", topics
                )
            )
        before = 0
        for stamp, has_bytes in kept:
            if stamp < before:
                raise LogDamagedError(
                    f"{self.path}: its messages are not in the order of time; convert it to MCAP"
                )
            if not has_bytes:
                raise LogDamagedError(f"{self.path}: a message on {self.topic} has no bytes")
            before = stamp
            yield stamp

    def _from(self, start: int) -> Iterator[tuple[int, bytes]]:
        for _, stamp, data in self._reader.messages(self._connections, start):
            yield stamp, data

    def _find(self, topic: str | None, reading: Reading) -> tuple[list[Any], Taken]:
        kinds = _kinds(self._reader, ros1=self._ros1)
        channels = [(name, kind, name) for name, kind in kinds.items()]
        chosen, decode = choose_images(self.path, topic, channels, reading)
        self.kind = kinds[chosen[0]]
        return [c for c in self._reader.connections if c.topic == chosen[0]], decode


def bag_channels(path: Path, *, whole: bool = False) -> list[ChannelFacts]:
    """What is on each topic of a bag, by the index of a .bag or the columns of a database.

    Args:
        path: the bag.
        whole: read every message in any case.

    Raises:
        CdmisfaError: the package rosbags is missing.
        LogDamagedError: rosbags cannot read it.
    """
    with _opened(path) as (reader, _):
        kinds = _kinds(reader, ros1=_is_ros1(path))
        stamps: dict[str, list[int]] = {name: [] for name in kinds}
        with explained(path, "rosbags"):
            if not (whole or _is_ros1(path)):
                for name, stamp in _rows(reader, "messages.timestamp", list(kinds)):
                    stamps[name].append(stamp)
            elif not whole:
                for connection in reader.connections:
                    entries = reader.indexes.get(connection.id, ())
                    stamps[str(connection.topic)] += [entry.time for entry in entries]
            else:
                for connection, stamp, _ in reader.messages():
                    stamps[str(connection.topic)].append(stamp)
    return [
        ChannelFacts(
            name,
            kind.encoding,
            kind.schema,
            len(stamps[name]),
            min(stamps[name], default=None),
            max(stamps[name], default=None),
            decoder_of(kind, IMAGES) is not None,
        )
        for name, kind in kinds.items()
    ]


def bag_topics(path: Path, reading: Reading = IMAGES) -> list[str]:
    """The topics of a bag with what is wanted; raises as `bag_channels` does."""
    with _opened(path) as (reader, _):
        kinds = _kinds(reader, ros1=_is_ros1(path))
    return [name for name, kind in kinds.items() if decoder_of(kind, reading) is not None]


def _rows(reader: Any, columns: str, topics: Sequence[str]) -> Iterator[tuple[Any, ...]]:
    """The name and some columns of the messages on topics of a rosbag2, by their times.

    Unlike their data these columns stand together, so that little of a file is read.
    """
    query = (
        f"SELECT topics.name, {columns} FROM messages "
        "JOIN topics ON messages.topic_id = topics.id "
        f"WHERE topics.name IN ({','.join('?' * len(topics))}) ORDER BY messages.timestamp"
    )
    for storage in getattr(reader.storage, "storages", [reader.storage]):
        yield from storage.dbconn.execute(query, tuple(topics))


def _is_ros1(path: Path) -> bool:
    return path.suffix == ".bag" and path.is_file()


def _kinds(reader: Any, *, ros1: bool) -> Mapping[str, MessageKind]:
    """The kind of each topic's messages; several publishers of ROS 1 are several connections."""
    return {str(c.topic): _kind(c, ros1=ros1) for c in reader.connections}


def _kind(connection: Any, *, ros1: bool) -> MessageKind:
    name, definition = str(connection.msgtype), str(connection.msgdef.data).encode()
    if ros1:
        return MessageKind(name.replace("/msg/", "/"), "ros1", definition, "ros1msg")
    language = "ros2idl" if connection.msgdef.format.name == "IDL" else "ros2msg"
    return MessageKind(name, "cdr", definition, language)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, bool]]:
    """A bag's reader, and whether the messages that it gives are packed."""
    try:
        from rosbags.rosbag1 import Reader as Rosbag1
        from rosbags.rosbag2 import Reader as Rosbag2
    except ImportError:
        raise CdmisfaError(
            f"{path} is a ROS bag, which needs rosbags: pip install rosbags (the extra [ros])"
        ) from None
    with plain_bag(path) as (plain, packed), contextlib.ExitStack() as opened:
        with explained(path, "rosbags"):
            reader: Any = Rosbag1(plain) if _is_ros1(path) else Rosbag2(plain)
            reader.open()
            opened.callback(reader.close)
            if _is_ros1(path):
                reader.chunks = {place: _bounded(chunk) for place, chunk in reader.chunks.items()}
            elif packed:  # rosbags would unpack whatever comes of it
                storage = reader.storage
                storage.metadata = storage.metadata._replace(compression_mode=None)
        yield reader, packed


def _bounded(chunk: Any) -> Any:
    """A chunk of a ROS 1 bag that unpacks to no more than one of an MCAP log may."""
    from rosbags.rosbag1.reader import decompressors

    if chunk.datasize > MAX_CHUNK:
        raise ValueError(f"a chunk of {chunk.datasize} bytes, above the limit of {MAX_CHUNK}")
    bounded = {"bz2": bz2.BZ2Decompressor, "lz4": lz4.frame.LZ4FrameDecompressor}
    for name, kind in bounded.items():
        if chunk.decompressor is decompressors[name]:
            return chunk._replace(decompressor=partial(_unpacked, kind))
    return chunk


def _unpacked(kind: Callable[[], Any], data: bytes) -> bytes:
    unpacking = kind()
    found = bytes(unpacking.decompress(data, max_length=MAX_CHUNK))
    if not unpacking.eof:
        raise ValueError(f"a chunk is cut short, or unpacks to more than {MAX_CHUNK} bytes")
    return found
