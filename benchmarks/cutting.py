"""Cutting logs, against copying the same bytes and against a loop of the mcap package."""

from __future__ import annotations

import contextlib
import heapq
import random
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from benchmarks.report import interleaved, middle, ratio, save
from recorder.log.files import to_disk
from replay.cutting.cut import cut_logs

SECOND = 10**9
PICTURE = 40_000
"""Bytes of a message of the camera, which do not compress, as those of JPEG."""


def write(path: Path, messages: int, seed: int = 0) -> Path:
    """A log of a camera, and of joints with messages that compress well, in turn."""
    numbers = random.Random(seed)
    noise = numbers.randbytes(1 << 22)
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD, enable_data_crcs=True)
        writer.start()
        schema = writer.register_schema("sensor_msgs/msg/CompressedImage", "ros2msg", b"")
        camera, joints = (
            writer.register_channel(topic, "cdr", schema) for topic in ("/camera", "/joints")
        )
        for i in range(messages):
            at, now = numbers.randrange(1 << 21), SECOND + i * SECOND // 30
            writer.add_message(camera, now, noise[at : at + PICTURE], now, i)
            writer.add_message(joints, now + 1, b"%08d" % i * 50, now + 1, i)
        writer.finish()
    return path


def copying(path: Path, out: Path) -> Callable[[], int]:
    """A call that copies a file to the disk; its bytes."""

    def call() -> int:
        shutil.copyfile(path, out)
        to_disk(out)
        return out.stat().st_size

    return call


def cutting(paths: Sequence[Path], out: Path, **how: Any) -> Callable[[], int]:
    """A call that cuts logs; the bytes of what is written."""

    def call() -> int:
        return sum(part.bytes for part in cut_logs(paths, out, force=True, **how).files)

    return call


def looping(
    paths: Sequence[Path],
    out: Path,
    *,
    start: float = 0.0,
    stop: float = 1e6,
    topics: tuple[str, ...] | None = None,
) -> Callable[[], int]:
    """A call that does the same with the mcap package, message by message."""

    def call() -> int:
        low, high = (SECOND + round(t * SECOND) for t in (start, stop))
        with contextlib.ExitStack() as opened:
            file = opened.enter_context(out.open("wb"))
            logs = [make_reader(opened.enter_context(path.open("rb")), True) for path in paths]
            writer = Writer(file, compression=CompressionType.ZSTD, enable_data_crcs=True)
            writer.start()
            numbers: dict[str, int] = {}
            each = [log.iter_messages(topics, starting_at=low, ending_before=high) for log in logs]
            found = heapq.merge(*each, key=lambda one: one[2].log_time)
            for schema, channel, one in found:
                if channel.topic not in numbers:
                    assert schema is not None
                    known = writer.register_schema(schema.name, schema.encoding, schema.data)
                    numbers[channel.topic] = writer.register_channel(channel.topic, "cdr", known)
                number = numbers[channel.topic]
                writer.add_message(number, one.log_time, one.data, one.publish_time, one.sequence)
            writer.finish()
        to_disk(out)
        return out.stat().st_size

    return call


def main(*, quick: bool = False, full: bool = False) -> None:
    """Measure, and write results/cutting.json."""
    del full
    rounds, messages = (2, 500) if quick else (7, 5000)
    rows = []
    with tempfile.TemporaryDirectory(dir=".") as made:
        folder = Path(made)
        logs = [write(folder / f"{i}.mcap", messages // (1 + i), i) for i in range(2)]
        half = messages / 60
        cases: dict[str, tuple[int, dict[str, Any]]] = {
            "all of a log": (1, {}),
            "the first half of it": (1, {"stop": half}),
            "its camera": (1, {"topics": ("/camera",)}),
            "two logs at once, joined": (2, {}),
        }
        for name, (count, how) in cases.items():
            of = logs[:count]
            cut_logs(of, folder / "same.mcap", force=True, **how)
            work = {
                "copying": copying(folder / "same.mcap", folder / "copy.mcap"),
                "cut": cutting(of, folder / "out.mcap", **how),
                "mcap": looping(of, folder / "loop.mcap", **how),
            }
            times = interleaved(work, rounds, time.perf_counter_ns)
            speeds = [round(1 / middle(times[k], 9)) for k in work]
            shares = [ratio(times["copying"], times["cut"]), ratio(times["mcap"], times["cut"])]
            rows.append([name, *speeds, *(f"{share:.2f}" for share in shares)])
    header = ["what", "copying, MB/s", "cut, MB/s", "mcap, MB/s", "cut / copying", "cut / mcap"]
    save(
        "cutting",
        "Cutting logs",
        f"A log of {messages} messages of {PICTURE} bytes that do not compress and as many of 400 "
        "that do, zstd; the other half as long. Copying is `shutil.copyfile` of the bytes that cut "
        "writes, mcap a loop of its reader and writer; all end when the disk has everything. "
        "Medians of rounds in which they take turns, wall time.",
        [(header, rows)],
    )
