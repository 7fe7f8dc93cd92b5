"""The first picture, and the first block learned, of a long log whose pictures do not compress."""

from __future__ import annotations

import contextlib
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, Writer

from benchmarks import foreign
from benchmarks.long_recordings import MEGABYTE, bytes_read
from benchmarks.report import middle, save
from cdmisfa.core.blocks import Block
from cdmisfa.core.learning import Learner, Sink
from cdmisfa.core.signals import BlockSignals
from cdmisfa.experiments.session import run_session
from cdmisfa.experiments.sources import open_source
from replay.open_sources import open_external


def write(path: Path, size: int) -> Path:
    """Write noise of 640x480 with mcap's own writer, in chunks of its own size, up to `size`."""
    rng = np.random.default_rng(0)
    made = [foreign.foxglove_raw(rng.integers(0, 256, foreign.VGA, np.uint8)) for _ in range(20)]
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start()
        schema = writer.register_schema(foreign.RAW, "protobuf", b"")
        channel = writer.register_channel(foreign.TOPIC, "protobuf", schema)
        i = 0
        while file.tell() < size:
            time_ns = i * foreign.STEP_NS
            writer.add_message(channel, time_ns, made[i % len(made)], time_ns)
            i += 1
        writer.finish()  # type: ignore[no-untyped-call]
        os.fsync(file.fileno())
    return path


def first_picture(path: Path) -> None:
    """Open a log and take its first frame."""
    with contextlib.closing(open_external(path)) as source:
        source.take(0, 1)


class FirstBlock(BaseException):
    """A block was learned: bytes that the learning thread had read by then.

    No `Exception`, because learning continues if a sink raises one.
    """


class UntilFirst(Sink):
    """Ends a run after its first block."""

    def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
        """See `Sink`."""
        raise FirstBlock(bytes_read("thread-self"))

    def event(self, t: int, iteration: int, text: str, level: str = "INFO") -> None:
        """See `Sink`."""

    def finish(self) -> None:
        """See `Sink`."""


def first_block(path: Path) -> int:
    """Do as `learn LOG -o RUN` until it has learned a block; bytes that it read for that."""
    before = bytes_read("thread-self")
    with tempfile.TemporaryDirectory() as folder:
        source, configuration = open_source([path])
        with contextlib.closing(source):
            try:
                run_session(
                    source,
                    configuration.learner,
                    Path(folder) / "run",
                    sections=configuration.tables(),
                    sinks=[UntilFirst()],
                )
            except FirstBlock as reached:
                return int(reached.args[0]) - before
    raise SystemExit(f"{path} is too short for a block")


def forget(path: Path) -> None:
    """Drop the system's cache of a file, if the system supports it."""
    if hasattr(os, "posix_fadvise"):
        with path.open("rb") as file:
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def seconds(
    path: Path, rounds: int, *, cold: bool, work: Callable[[Path], object] = first_picture
) -> float:
    """The median of how long some work on a log takes, by the wall's clock."""
    durations = []
    for _ in range(rounds):
        if cold:
            forget(path)
        start = time.perf_counter()
        work(path)
        durations.append(time.perf_counter() - start)
    return middle(durations, 3)


def main(*, quick: bool = False) -> None:
    """Measure, and write results/opening.json."""
    rows, learned = [], []
    for size in (20, 100 if quick else 1000):
        with tempfile.TemporaryDirectory() as folder:
            path = write(Path(folder) / "log.mcap", size * MEGABYTE)
            first_picture(path)
            before = bytes_read()
            first_picture(path)
            read = bytes_read() - before
            row: list[object] = [f"{size} MB"]
            row += [seconds(path, 5, cold=cold) for cold in (True, False)]
            rows.append([*row, f"{read / path.stat().st_size:.4f}x"])
            first_block(path)
            row = [f"{size} MB"]
            row += [seconds(path, 5, cold=cold, work=first_block) for cold in (True, False)]
            learned.append([*row, round(first_block(path) / MEGABYTE)])
    save(
        "opening",
        "Open a long log",
        "Time from opening an uncompressed external MCAP log (640x480) until its first "
        "frame, with the file on disk (cold) and in memory (warm), and the part of the file "
        "that is read. Second table: until `learn` has learned its first block.",
        [
            (["log", "cold, seconds", "warm, seconds", "part read"], rows),
            (["log", "learn: cold, seconds", "learn: warm, seconds", "read, MB"], learned),
        ],
    )
