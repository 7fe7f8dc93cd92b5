"""ROS bags: the images, or numbers, of a rosbag2 (.db3) or of a ROS 1 .bag, through rosbags."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path, PurePath
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
import zstandard

from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from cdmisfa.core.untrusted import check_regular, opened_regular, read_regular
from recorder.images.messages import MessageKind, decoder_of
from recorder.images.options import IMAGES, NUMBERS_RECIPE, InputOptions
from recorder.mcap.records import MAX_CHUNK
from replay.camera_logs.stream import (
    ChannelFacts,
    MessageImages,
    choose_images,
    explained,
    sorted_times,
)

Found = TypeVar("Found")

BAGS: Final = (".bag", ".db3")

METADATA: Final = "metadata.yaml"
MAX_METADATA: Final = 1024 * 1024
"""Largest metadata.yaml that is read, in bytes."""
MOST_TIMES: Final = 100
"""How many times the size of a packed file what is in it may have, where it is more than a chunk's.

Images of anything but one colour are packed to more than that.
"""


class _Bag(NamedTuple):
    """An opened bag: readers of rosbags for its parts, one after the other, and its format."""

    readers: Sequence[Any]
    ros1: bool

    def kinds(self) -> dict[str, MessageKind]:
        """Return the kind of each topic's messages; in ROS 1 each publisher is a connection."""
        found = {}
        for connection in (c for reader in self.readers for c in reader.connections):
            definition = str(connection.msgdef.data).encode()
            name, idl = str(connection.msgtype), connection.msgdef.format.name == "IDL"
            kind = MessageKind(name, "cdr", definition, "ros2idl" if idl else "ros2msg")
            if self.ros1:
                kind = MessageKind(name.replace("/msg/", "/"), "ros1", definition, "ros1msg")
            found[str(connection.topic)] = kind
        return found

    def messages(
        self, topics: Sequence[str], start: int | None = None
    ) -> Iterator[tuple[str, int, Any]]:
        """Yield topic, time and data of each message on some topics, from a time on."""
        for reader in self.readers:
            if chosen := [c for c in reader.connections if c.topic in topics]:
                for connection, stamp, data in reader.messages(chosen, start):
                    yield str(connection.topic), stamp, data

    def stamps(self, topics: Sequence[str]) -> Iterator[tuple[str, int]]:
        """Yield topic and time of each message on some topics, of a rosbag2 without its data."""
        if self.ros1:
            yield from ((topic, stamp) for topic, stamp, _ in self.messages(topics))
            return
        query = (
            "SELECT topics.name, messages.timestamp FROM messages "
            "JOIN topics ON messages.topic_id = topics.id "
            f"WHERE topics.name IN ({','.join('?' * len(topics))}) ORDER BY messages.timestamp"
        )
        for reader in self.readers:
            for storage in getattr(reader.storage, "storages", [reader.storage]):
                yield from storage.dbconn.execute(query, tuple(topics))


class BagImages(MessageImages):
    """The images, or the numbers, on a topic of a .bag, .db3 or rosbag2's folder, by stamps.

    Raises:
        CdmisfaError: the package rosbags is missing.
        UsageError: no such topic, or no images on it.
        LogDamagedError: rosbags cannot read it.
    """

    def __init__(self, path: Path, topic: str | None, *, reading: InputOptions = IMAGES) -> None:
        self.path, self.color = path, (reading.color is True)
        if reading.fields:
            self.recipe, self.fields = NUMBERS_RECIPE, reading.fields
        self._messages: Iterator[tuple[str, int, Any]] = iter(())
        self._next = -1
        with contextlib.ExitStack() as opened:
            self._bag = bag = opened.enter_context(_opened(path))
            kinds = bag.kinds()
            channels = [(name, kind, name) for name, kind in kinds.items()]
            (self.topic, *_), self.decode = choose_images(path, topic, channels, reading)
            self.kind = kinds[self.topic]
            with explained(path, "rosbags"):
                stamps = [stamp for _, stamp in bag.stamps([self.topic])]
            if stamps != sorted(stamps):
                raise LogDamagedError(
                    f"{path}: its messages are not in the order of time; convert it to MCAP"
                )
            if not stamps:
                raise UsageError(f"{path}: there is no message on {self.topic}")
            self.times = sorted_times(f"{path}: {self.topic}", stamps)
            self._opened = opened.pop_all()
        self.remarks = [f"{path}: a ROS bag has no checksums, damaged pixels would go unnoticed"]

    def taken(self, row: int, take: Callable[[Any], Found]) -> Found:
        with explained(self.path, "rosbags"):
            if row != self._next:
                self._messages = self._bag.messages([self.topic], int(self.times[row]))
                self._next = int(np.searchsorted(self.times, self.times[row]))
            while self._next <= row:
                _, _, data = next(self._messages, ("", 0, b""))
                self._next += 1
        if not isinstance(data, bytes):  # SQLite keeps anything in any column
            raise LogDamagedError(f"{self.where(row)}: the message has no bytes")
        return take(data)

    def close(self) -> None:
        self._messages = iter(())
        self._opened.close()


def bag_channels(path: Path, *, whole: bool = False) -> list[ChannelFacts]:
    """What is on each topic of a bag, by the index of a .bag or the columns of a database.

    Args:
        path: the bag.
        whole: read every message in any case.

    Raises:
        CdmisfaError: the package rosbags is missing.
        LogDamagedError: rosbags cannot read it.
    """
    with _opened(path) as bag:
        kinds = bag.kinds()
        stamps: dict[str, list[int]] = {name: [] for name in kinds}
        with explained(path, "rosbags"):
            if bag.ros1 and not whole:
                for reader in bag.readers:
                    for connection in reader.connections:
                        entries = reader.indexes.get(connection.id, ())
                        stamps[str(connection.topic)] += [entry.time for entry in entries]
            else:
                messages = bag.messages if whole else bag.stamps
                for name, stamp, *_ in messages(list(kinds)):
                    stamps[name].append(stamp)
    found = []
    for name, kind in kinds.items():
        own = stamps[name]
        ends = min(own, default=None), max(own, default=None)
        images = decoder_of(kind, IMAGES) is not None
        found.append(ChannelFacts(name, kind.encoding, kind.schema, len(own), *ends, images))
    return found


def bag_topics(path: Path, reading: InputOptions = IMAGES) -> list[str]:
    """The topics of a bag with what is wanted; raises as `bag_channels` does."""
    with _opened(path) as bag:
        kinds = bag.kinds()
    return [name for name, kind in kinds.items() if decoder_of(kind, reading) is not None]


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[_Bag]:
    try:
        from rosbags.rosbag1 import Reader as Rosbag1
        from rosbags.rosbag2 import Reader as Rosbag2
    except ImportError:
        raise CdmisfaError(
            f"{path} is a ROS bag, which needs rosbags: pip install rosbags (the extra [ros])"
        ) from None
    ros1 = path.suffix == ".bag" and path.is_file()
    with _parts(path) as parts, contextlib.ExitStack() as opened:
        with explained(path, "rosbags"):
            readers: list[Any] = [Rosbag1(part) if ros1 else Rosbag2(part) for part in parts]
            for reader in readers:
                reader.open()
                opened.callback(reader.close)
        yield _Bag(readers, ros1)


@contextlib.contextmanager
def _parts(path: Path) -> Iterator[Sequence[Path]]:
    """Yield what rosbags opens: the bag, or its packed files, unpacked into a temporary folder.

    rosbags unpacks files without a limit; chunks and messages take memory alone, of the budget.

    Args:
        path: a file, or the folder of a rosbag2.

    Raises:
        UsageError: a file of it is no regular one.
        LogDamagedError: it is no bag, or unpacks to far more than it is.
    """
    if not path.is_dir():
        check_regular(path)
        yield [path]
        return
    from ruamel.yaml import YAML

    with explained(path / METADATA, "YAML"):
        text = read_regular(path / METADATA, MAX_METADATA).decode("utf-8")
        said = YAML(typ="safe").load(text)["rosbag2_bagfile_information"]
        files = [path / PurePath(str(name)).name for name in said["relative_file_paths"]]
        packed, kept_as = said.get("compression_mode"), str(said["storage_identifier"])
    if kept_as != "sqlite3":
        raise LogDamagedError(
            f"{path}: files of {kept_as[:40]} are read if they are MCAP and called .mcap: "
            "unpack them with zstd -d"
        )
    for file in files:
        check_regular(file)
    if str(packed).lower() != "file":
        yield [path]
        return
    with tempfile.TemporaryDirectory() as folder:
        yield [_unpacked(file, Path(folder)) for file in files]


def _unpacked(packed: Path, folder: Path) -> Path:
    """Unpack a file into a folder, unless it becomes far too large or leaves no room on the disk.

    Raises:
        LogDamagedError: it would, or it is not packed by zstd.
    """
    target = folder / packed.stem
    with explained(packed, "zstd"), opened_regular(packed) as source, target.open("xb") as out:
        most = max(os.fstat(source.fileno()).st_size * MOST_TIMES, MAX_CHUNK)
        most = min(most, shutil.disk_usage(folder).free // 2)
        unpacking = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK // 2)
        reader = unpacking.stream_reader(source, read_across_frames=True)
        while part := reader.read(1 << 20):
            out.write(part)
            if out.tell() > most:
                raise LogDamagedError(
                    f"{packed} unpacks to more than {most} bytes, the limit: unpack it with "
                    f"zstd -d, and take compression_mode out of {METADATA}"
                )
    return target
