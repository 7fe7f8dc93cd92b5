"""ROS bags: the images, or numbers, of a rosbag2 (.db3) or of a ROS 1 .bag, through rosbags.

What is packed is unpacked here, within limits that rosbags does not know.
"""

from __future__ import annotations

import bz2
import contextlib
import io
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path, PurePath
from typing import Any, Final, NamedTuple, TypeVar

import lz4.frame
import numpy as np
import zstandard

from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from cdmisfa.core.untrusted import begun, check_regular, opened_regular, read_regular
from recorder.images.decoding import MessageKind, decoder_of
from recorder.images.options import IMAGES, NUMBERS_RECIPE, Reading
from recorder.mcap.records import MAX_CHUNK
from replay.camera_logs.stream import (
    ChannelFacts,
    MessageImages,
    choose_images,
    explained,
    sorted_times,
)

Found = TypeVar("Found")

_HEADS: Final = {".bag": b"#ROSBAG V", ".db3": b"SQLite format 3\0"}
"""What each kind begins with."""

BAGS: Final = tuple(_HEADS)

METADATA: Final = "metadata.yaml"
MAX_METADATA: Final = 1024 * 1024
"""Largest metadata.yaml that is read, in bytes."""
MOST_TIMES: Final = 100
"""How many times the size of a packed file what is in it may have, where it is more than a chunk's.

Images of anything but one colour are packed to more than that.
"""


class _Bag(NamedTuple):
    """An opened bag: its reader, its format, and whether each message is packed."""

    reader: Any
    ros1: bool
    packed: bool

    def kinds(self) -> dict[str, MessageKind]:
        """The kind of each topic's messages; of ROS 1 each publisher is a connection."""
        found = {}
        for connection in self.reader.connections:
            definition = str(connection.msgdef.data).encode()
            name, idl = str(connection.msgtype), connection.msgdef.format.name == "IDL"
            kind = MessageKind(name, "cdr", definition, "ros2idl" if idl else "ros2msg")
            if self.ros1:
                kind = MessageKind(name.replace("/msg/", "/"), "ros1", definition, "ros1msg")
            found[str(connection.topic)] = kind
        return found

    def connections(self, topics: Sequence[str]) -> list[Any]:
        return [c for c in self.reader.connections if c.topic in topics]

    def messages(self, topics: Sequence[str], *, whole: bool) -> Iterator[tuple[str, int, bool]]:
        """The topic and the time of each message on some, and whether it holds bytes.

        Args:
            topics: the topics.
            whole: read the data of a rosbag2, too, beside which these stand together.
        """
        if whole or self.ros1:
            for connection, stamp, data in self.reader.messages(self.connections(topics)):
                yield str(connection.topic), stamp, isinstance(data, bytes)
            return
        query = (
            "SELECT topics.name, messages.timestamp, typeof(messages.data) FROM messages "
            "JOIN topics ON messages.topic_id = topics.id "
            f"WHERE topics.name IN ({','.join('?' * len(topics))}) ORDER BY messages.timestamp"
        )
        for storage in getattr(self.reader.storage, "storages", [self.reader.storage]):
            for name, stamp, kind in storage.dbconn.execute(query, tuple(topics)):
                yield name, stamp, kind == "blob"  # SQLite keeps anything in any column


class BagImages(MessageImages):
    """The images, or the numbers, on a topic of a .bag, .db3 or rosbag2's folder, by stamps.

    Raises:
        CdmisfaError: the package rosbags is missing.
        UsageError: no such topic, or no images on it.
        LogDamagedError: rosbags cannot read it.
    """

    def __init__(self, path: Path, topic: str | None, *, reading: Reading = IMAGES) -> None:
        self.path, self.color = path, reading.color
        if reading.fields:
            self.recipe, self.fields = NUMBERS_RECIPE, reading.fields
        self._messages: Iterator[tuple[Any, int, bytes]] = iter(())
        self._next = -1
        with contextlib.ExitStack() as opened:
            self._bag = bag = opened.enter_context(_opened(path))
            kinds = bag.kinds()
            channels = [(name, kind, name) for name, kind in kinds.items()]
            (self.topic, *_), self.decode = choose_images(path, topic, channels, reading)
            self.kind = kinds[self.topic]
            stamps: list[int] = []
            with explained(path, "rosbags"):
                for _, stamp, has_bytes in bag.messages([self.topic], whole=False):
                    if stamps and stamp < stamps[-1]:
                        raise LogDamagedError(
                            f"{path}: its messages are not in the order of time; convert it to MCAP"
                        )
                    if not has_bytes:
                        raise LogDamagedError(f"{path}: a message on {self.topic} has no bytes")
                    stamps.append(stamp)
            if not stamps:
                raise UsageError(f"{path}: there is no message on {self.topic}")
            self.times = sorted_times(f"{path}: {self.topic}", stamps)
            self._opened = opened.pop_all()
        self.remarks = [f"{path}: a ROS bag has no checksums, damaged pixels would go unnoticed"]

    def taken(self, row: int, take: Callable[[bytes], Found]) -> Found:
        with explained(self.path, "rosbags"):
            if row != self._next:
                connections = self._bag.connections([self.topic])
                self._messages = self._bag.reader.messages(connections, int(self.times[row]))
                self._next = int(np.searchsorted(self.times, self.times[row]))
            while self._next <= row:
                _, _, data = next(self._messages, (None, 0, b""))
                self._next += 1
            if self._bag.packed:
                data = _unpacked_message(data)
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
                for connection in bag.reader.connections:
                    entries = bag.reader.indexes.get(connection.id, ())
                    stamps[str(connection.topic)] += [entry.time for entry in entries]
            else:
                for name, stamp, _ in bag.messages(list(kinds), whole=whole):
                    stamps[name].append(stamp)
    found = []
    for name, kind in kinds.items():
        own = stamps[name]
        ends = min(own, default=None), max(own, default=None)
        images = decoder_of(kind, IMAGES) is not None
        found.append(ChannelFacts(name, kind.encoding, kind.schema, len(own), *ends, images))
    return found


def bag_topics(path: Path, reading: Reading = IMAGES) -> list[str]:
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
    with _unpacked_bag(path) as (plain, packed), contextlib.ExitStack() as opened:
        with explained(path, "rosbags"):
            reader: Any = Rosbag1(plain) if ros1 else Rosbag2(plain)
            reader.open()
            opened.callback(reader.close)
            if ros1:
                reader.chunks = {place: _bounded(chunk) for place, chunk in reader.chunks.items()}
            elif packed:  # rosbags would unpack it without a limit
                storage = reader.storage
                storage.metadata = storage.metadata._replace(compression_mode=None)
        yield _Bag(reader, ros1, packed)


def _bounded(chunk: Any) -> Any:
    """A chunk of a ROS 1 bag with a limit on what it unpacks to."""
    from rosbags.rosbag1.reader import decompressors

    if chunk.datasize > MAX_CHUNK:
        raise ValueError(f"a chunk of {chunk.datasize} bytes, above the limit of {MAX_CHUNK}")
    bounded = {"bz2": bz2.BZ2Decompressor, "lz4": lz4.frame.LZ4FrameDecompressor}
    for name, kind in bounded.items():
        if chunk.decompressor is decompressors[name]:
            return chunk._replace(decompressor=partial(_unpacked_chunk, kind))
    return chunk


def _unpacked_chunk(kind: Callable[[], Any], data: bytes) -> bytes:
    unpacking = kind()
    found = bytes(unpacking.decompress(data, max_length=MAX_CHUNK))
    if not unpacking.eof:
        raise ValueError(f"a chunk is cut short, or unpacks to more than {MAX_CHUNK} bytes")
    return found


def _zstd(source: Any) -> Any:
    """A stream of what zstd packed."""
    unpacking = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK // 2)
    return unpacking.stream_reader(source, read_across_frames=True)


def _unpacked_message(data: bytes) -> bytes:
    with _zstd(io.BytesIO(data)) as reader:
        found = bytes(reader.read(MAX_CHUNK + 1))
    if len(found) > MAX_CHUNK:
        raise ValueError(f"a message unpacks to more than {MAX_CHUNK} bytes, the limit")
    return found


@contextlib.contextmanager
def _unpacked_bag(path: Path) -> Iterator[tuple[Path, bool]]:
    """A bag with plain files, the same or a copy, and whether each of its messages is packed.

    Args:
        path: a file, or the folder of a rosbag2.

    Raises:
        UsageError: a file of it is no regular one.
        LogDamagedError: it is no bag, or unpacks to far more than it is.
    """
    if not path.is_dir():
        if not begun(path).startswith(_HEADS[path.suffix]):
            raise LogDamagedError(f"{path}: it is no ROS bag, by its first bytes")
        yield path, False
        return
    from ruamel.yaml import YAML

    with explained(path / METADATA, "YAML"):
        whole = YAML(typ="safe").load(read_regular(path / METADATA, MAX_METADATA).decode("utf-8"))
        said = whole["rosbag2_bagfile_information"]
        names = [PurePath(str(name)).name for name in said["relative_file_paths"]]
        packed = str(said.get("compression_mode") or "").lower()
        kept_as = str(said["storage_identifier"])
    if kept_as != "sqlite3":
        raise LogDamagedError(
            f"{path}: files of {kept_as[:40]} are read if they are MCAP and called .mcap: "
            "unpack them with zstd -d"
        )
    for name in names:
        check_regular(path / name)
    if packed != "file":
        yield path, packed == "message"
        return
    with tempfile.TemporaryDirectory() as temporary:
        copy = Path(temporary)
        for name in names:
            _unpack(path / name, copy / PurePath(name).stem)
        said["relative_file_paths"] = [PurePath(name).stem for name in names]
        said["compression_mode"] = said["compression_format"] = ""
        with (copy / METADATA).open("w", encoding="utf-8") as file:
            YAML(typ="safe").dump(whole, file)
        yield copy, False


def _unpack(packed: Path, target: Path) -> None:
    """Unpack a file into another, unless it becomes far too large or leaves no room on the disk.

    Raises:
        LogDamagedError: it would, or it is not packed by zstd.
    """
    with explained(packed, "zstd"), opened_regular(packed) as source, target.open("xb") as out:
        most = max(os.fstat(source.fileno()).st_size * MOST_TIMES, MAX_CHUNK)
        most = min(most, shutil.disk_usage(target.parent).free // 2)
        with _zstd(source) as reader:
            while part := reader.read(1 << 20):
                out.write(part)
                if out.tell() > most:
                    raise LogDamagedError(
                        f"{packed} unpacks to more than {most} bytes, the limit: unpack it with "
                        f"zstd -d, and take compression_mode out of {METADATA}"
                    )
