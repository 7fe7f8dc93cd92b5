"""Reading all messages of an MCAP log, against small-mcap and mcap."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import small_mcap
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from benchmarks.foreign import pictures, ros2_raw
from benchmarks.report import interleaved, middle, ratio, save
from recorder.mcap.reader import LogReader


class Topic(NamedTuple):
    """A topic of a log: its period (ns), its number of messages, and payloads that repeat."""

    name: str
    period: int
    number: int
    payloads: Sequence[bytes]


def floats(values: int) -> list[bytes]:
    """Payloads of noise, as of joints or an IMU."""
    rng = np.random.default_rng(1)
    return [rng.normal(size=values).tobytes() for _ in range(64)]


def images(n: int, height: int, width: int) -> list[bytes]:
    """Payloads of ROS 2 images."""
    return [ros2_raw(image) for image in pictures(n, height, width)]


def write(path: Path, compression: str, topics: Sequence[Topic]) -> int:
    """Write topics in the order of log time with mcap's own writer; return the payloads' bytes."""
    events, total = [], 0
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType[compression.upper()])
        writer.start(profile="ros2")
        for topic in topics:
            channel = writer.register_channel(topic.name, "cdr", 0)
            for i in range(topic.number):
                data = topic.payloads[i % len(topic.payloads)]
                events.append((i * topic.period, channel, data))
                total += len(data)
        for at, channel, data in sorted(events, key=lambda event: event[:2]):
            writer.add_message(channel, at, data, at)
        writer.finish()  # type: ignore[no-untyped-call]
    return total


def ours(path: Path, topic: str | None) -> int:
    """Return the number of messages that cdmisfa reads, each chunk with its CRC."""
    with LogReader(path) as reader:
        topics = topic and [topic]
        return sum(bool(m.data and m.log_time >= 0) for m in reader.messages(topics))


def small(path: Path, topic: str | None, *, crc: bool) -> int:
    """Return the number of messages that small-mcap reads."""
    with path.open("rb") as file:
        records = small_mcap.read_message(
            file, lambda channel, _: topic in (None, channel.topic), validate_crc=crc
        )
        return sum(bool(m.data and m.log_time >= 0) for _, _, m in records)


def mcaps(path: Path, topic: str | None) -> int:
    """Return the number of messages that mcap reads, each chunk with its CRC."""
    with path.open("rb") as file:
        topics = topic and [topic]
        records = make_reader(file, validate_crcs=True).iter_messages(topics=topics)
        return sum(bool(m.data and m.log_time >= 0) for _, _, m in records)


READERS: Mapping[str, Callable[[Path, str | None], int]] = {
    "cdmisfa": ours,
    "small-mcap": partial(small, crc=True),
    "mcap": mcaps,
    "small-mcap without CRC": partial(small, crc=False),
}
NOTE = (
    "Topic, time and payload of every message, stored in the order of log time. Readers check "
    "the CRC of each chunk, except in the last column: without a check, small-mcap needs no pass "
    "over the bytes, and hands out parts of the chunk, where cdmisfa returns a copy. CPU time of "
    "all threads; the factors say how many times as fast cdmisfa is."
)


def main(*, quick: bool = False) -> None:
    """Measure, and write results/messages.json."""
    rounds, share = (3, 4) if quick else (11, 1)
    joints, vga, hd = floats(48), images(40, 240, 320), images(12, 1080, 1920)
    robot = [Topic("/cam", 75_000_000, 800, vga), Topic("/joints", 5_000_000, 11_800, joints)]
    cases: dict[str, tuple[Sequence[Topic], str | None]] = {
        "12,600 images and joint states": (robot, None),
        "images of 1920x1080": ([Topic("/cam", 75_000_000, 48, hd)], None),
        "messages of 96 bytes": ([Topic("/imu", 1_000_000, 100_000, floats(12))], None),
        "one topic of forty": (
            [Topic(f"/t{k:02}", 10_000_000, 2500, joints) for k in range(40)],
            "/t07",
        ),
    }
    rows: list[list[object]] = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.mcap"
        for name, (topics, selected) in cases.items():
            for compression in ("none", "lz4", "zstd"):
                size = write(
                    path, compression, [t._replace(number=t.number // share) for t in topics]
                )
                work = {reader: partial(f, path, selected) for reader, f in READERS.items()}
                times = interleaved(work, rounds, time.process_time_ns)
                mine, *others = times.values()
                factors = [f"{ratio(theirs, mine):.2f}x" for theirs in others]
                rows.append([f"{name}, {compression}", size // 10**6, middle(mine, 2), *factors])
    header = ["log", "MB", "cdmisfa, µs a message", "small-mcap", "mcap", "small-mcap without CRC"]
    save("messages", "Reading messages", NOTE, [(header, rows)])
