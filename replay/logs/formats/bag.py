"""Read ROS bags, rosbag2 (.db3) or ROS 1 (.bag), with the package rosbags."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path, PurePath
from typing import Any, Final, NamedTuple

import numpy as np
import zstandard

from cdmisfa.core.arrays import IntArray
from cdmisfa.core.errors import LogDamagedError
from cdmisfa.core.untrusted import check_regular, opened_regular, read_regular
from recorder.images.messages import MessageKind, decoder_of
from recorder.images.options import InputOptions
from recorder.mcap.records import MAX_CHUNK
from replay.logs.formats.messages import choose_topics, left_out, message_stream
from replay.logs.stream import ChannelInfo, ExternalChannel, LogStream, limited

ENDINGS: Final = (".bag", ".db3")

METADATA: Final = "metadata.yaml"

# Largest metadata.yaml that is read, in bytes.
MAX_METADATA: Final = 1024 * 1024

# Largest ratio of unpacked to packed size, against files that would fill the disk. Contents up to
# the size of a chunk are always accepted. Only images of one color exceed the ratio.
MOST_TIMES: Final = 100


class Bag(NamedTuple):
    """An open bag: readers of rosbags for its parts, one after the other, and its format."""

    path: Path
    readers: Sequence[Any]
    ros1: bool

    def kinds(self) -> dict[str, MessageKind]:
        """Return the kind of each topic's messages; in ROS 1 each publisher is a connection."""
        kinds_by_topic = {}
        for connection in (c for reader in self.readers for c in reader.connections):
            definition = str(connection.msgdef.data).encode()
            name, idl = str(connection.msgtype), connection.msgdef.format.name == "IDL"
            kind = MessageKind(name, "cdr", definition, "ros2idl" if idl else "ros2msg")
            if self.ros1:
                kind = MessageKind(name.replace("/msg/", "/"), "ros1", definition, "ros1msg")
            kinds_by_topic[str(connection.topic)] = kind
        return kinds_by_topic

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

    def fetcher(self, topic: str, times: IntArray) -> Callable[[int], bytes]:
        """Return a function that reads the message of a row of a topic, fastest row after row."""
        remaining: Iterator[tuple[str, int, Any]] = iter(())
        next_row = -1

        def fetch(row: int) -> bytes:
            nonlocal remaining, next_row
            if row != next_row:
                remaining = self.messages([topic], int(times[row]))
                next_row = int(np.searchsorted(times, times[row]))
            while next_row <= row:
                _, _, data = next(remaining, ("", 0, b""))
                next_row += 1
            if not isinstance(data, bytes):  # SQLite keeps anything in any column
                at = f"{self.path}: {topic} at {times[row]} ns"
                raise LogDamagedError(f"{at}: the message is not stored as bytes")
            return data

        return fetch


def streams(
    path: Path, options: InputOptions, opened: ExitStack, *, skip_damaged: bool = False
) -> list[LogStream]:
    """Open the topics of a .bag, .db3 or rosbag2's folder.

    Raises:
        UsageError: no such topic, or it has no images or fields as requested.
        LogDamagedError: rosbags cannot read it.
    """
    with open_bag(path) as bag:
        kinds = [(topic, kind, topic) for topic, kind in bag.kinds().items()]
    opened_streams = []
    chosen = choose_topics(path, kinds, options)
    notes = left_out(path, (topic for topic, _, _ in kinds), chosen, options)
    for topic, kind, _ in chosen:
        bag = opened.enter_context(open_bag(path))  # a reader holds one chunk only
        with limited(path, "rosbags"):
            times = np.array([stamp for _, stamp in bag.stamps([topic])], np.int64)
        if (times[1:] < times[:-1]).any():
            raise LogDamagedError(
                f"{path}: its messages are not in order of time; convert it to MCAP first"
            )
        fetch = bag.fetcher(topic, times)
        about = {"program": "rosbags", "remarks": [_remark(path)], "notes": notes}
        opened_streams.append(message_stream(path, topic, kind, options, times, fetch, **about))
    return opened_streams


def bag_channels(path: Path, *, whole: bool = False) -> list[ExternalChannel]:
    """Return the topics of a bag, by the index of a .bag or the columns of a database.

    Args:
        path: the bag.
        whole: read every message in any case.

    Raises:
        LogDamagedError: rosbags cannot read it.
    """
    with open_bag(path) as bag:
        kinds = bag.kinds()
        stamps: dict[str, list[int]] = {name: [] for name in kinds}
        with limited(path, "rosbags"):
            if bag.ros1 and not whole:
                for reader in bag.readers:
                    for connection in reader.connections:
                        entries = reader.indexes.get(connection.id, ())
                        stamps[str(connection.topic)] += [entry.time for entry in entries]
            else:
                messages = bag.messages if whole else bag.stamps
                for name, stamp, *_ in messages(list(kinds)):
                    stamps[name].append(stamp)
    channels = []
    for name, kind in kinds.items():
        times = stamps[name]
        ends = min(times, default=None), max(times, default=None)
        images = decoder_of(kind, InputOptions()) is not None
        info = ChannelInfo(name, kind.encoding, kind.schema, len(times), *ends)
        channels.append(ExternalChannel(info, images, remarks=(_remark(path),)))
    return channels


def _remark(path: Path) -> str:
    return f"{path}: a ROS bag has no checksums, so damaged pixels cannot be detected"


@contextlib.contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a bag; raises as `bag_channels` does."""
    from rosbags.rosbag1 import Reader as Rosbag1
    from rosbags.rosbag2 import Reader as Rosbag2

    ros1 = path.suffix == ".bag" and path.is_file()
    with _parts(path) as parts, ExitStack() as opened:
        with limited(path, "rosbags"):
            readers: list[Any] = [Rosbag1(part) if ros1 else Rosbag2(part) for part in parts]
            for reader in readers:
                reader.open()
                opened.callback(reader.close)
        yield Bag(path, readers, ros1)


@contextlib.contextmanager
def _parts(path: Path) -> Iterator[Sequence[Path]]:
    """Yield the paths for rosbags: the bag, or its packed files, unpacked to a temporary folder.

    Files are unpacked here, because rosbags sets no limit. It unpacks chunks and messages in
    memory, which has a budget.

    Raises:
        UsageError: a file of the bag is not a regular file.
        LogDamagedError: the folder is not a bag, or its files unpack to more than the limit.
    """
    if not path.is_dir():
        check_regular(path)
        yield [path]
        return
    from ruamel.yaml import YAML

    with limited(path / METADATA, "YAML"):
        text = read_regular(path / METADATA, MAX_METADATA).decode("utf-8")
        info = YAML(typ="safe").load(text)["rosbag2_bagfile_information"]
        files = [path / PurePath(str(name)).name for name in info["relative_file_paths"]]
        packed, storage = info.get("compression_mode"), str(info["storage_identifier"])
    if storage != "sqlite3":
        raise LogDamagedError(
            f"{path}: storage {storage[:40]} is supported only as .mcap files: unpack them with "
            "zstd -d"
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
        LogDamagedError: the file exceeds the limit, or was not packed by zstd.
    """
    target = folder / packed.stem
    with limited(packed, "zstd"), opened_regular(packed) as source, target.open("xb") as out:
        most = max(os.fstat(source.fileno()).st_size * MOST_TIMES, MAX_CHUNK)
        most = min(most, shutil.disk_usage(folder).free // 2)
        unpacking = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK // 2)
        reader = unpacking.stream_reader(source, read_across_frames=True)
        while part := reader.read(1 << 20):
            out.write(part)
            if out.tell() > most:
                raise LogDamagedError(
                    f"{packed} unpacks to more than the limit of {most} bytes: unpack it with "
                    f"zstd -d, and remove compression_mode from {METADATA}"
                )
    return target
