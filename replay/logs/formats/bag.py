"""Read ROS bags, rosbag2 (.db3) or ROS 1 (.bag), with the package rosbags."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import zstandard

from cdmisfa.core.arrays import IntArray
from cdmisfa.core.errors import LogDamagedError
from cdmisfa.core.untrusted import check_regular, opened_regular
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
    """An open bag: its reader of rosbags, and its format."""

    path: Path
    reader: Any
    ros1: bool

    def kinds(self) -> dict[str, MessageKind]:
        """Return the kind of each topic's messages; in ROS 1 each publisher is a connection."""
        kinds_by_topic = {}
        for connection in self.reader.connections:
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
        if chosen := [c for c in self.reader.connections if c.topic in topics]:
            for connection, stamp, data in self.reader.messages(chosen, start):
                yield str(connection.topic), stamp, data

    def stamps(self, topics: Sequence[str]) -> Iterator[tuple[str, int]]:
        """Yield topic and time of each message on some topics, of SQLite without its data."""
        storage = getattr(self.reader, "storage", None)
        storages = getattr(storage, "storages", [storage])
        if not all(hasattr(storage, "dbconn") for storage in storages):
            yield from ((topic, stamp) for topic, stamp, _ in self.messages(topics))
            return
        query = (
            "SELECT topics.name, messages.timestamp FROM messages "
            "JOIN topics ON messages.topic_id = topics.id "
            f"WHERE topics.name IN ({','.join('?' * len(topics))}) ORDER BY messages.timestamp"
        )
        for storage in storages:
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
                for connection in bag.reader.connections:
                    entries = bag.reader.indexes.get(connection.id, ())
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
    if path.is_dir():
        check_regular(path / METADATA, MAX_METADATA)
        for file in sorted(path.glob("*.zst*")):
            _check_unpacked_size(file)
    else:
        check_regular(path)
    with limited(path, "rosbags"):
        reader: Any = Rosbag1(path) if ros1 else Rosbag2(path)
        reader.open()
    with contextlib.closing(reader):
        yield Bag(path, reader, ros1)


def _check_unpacked_size(packed: Path) -> None:
    """Raise LogDamagedError if a file unpacks to far too much, which rosbags does not check."""
    with limited(packed, "zstd"), opened_regular(packed) as source:
        size, most = 0, max(packed.stat().st_size * MOST_TIMES, MAX_CHUNK)
        reader = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK // 2).stream_reader(source)
        while part := reader.read(1 << 20):
            size += len(part)
            if size > most:
                raise LogDamagedError(f"{packed} unpacks to more than the limit of {most} bytes")
