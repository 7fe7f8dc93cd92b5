"""Reading a recording into blocks, against mcap's reader and decompression alone."""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import zstandard
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader

from benchmarks import long_recordings
from benchmarks.recordings import SAMPLE, write_pictures
from benchmarks.report import interleaved, ratio, save
from replay.recordings.source import RecordedSource

TAU = 40


def ours(path: Path) -> Callable[[], int]:
    """A call that plays a file in blocks of 40 frames, with its ground truth and all CRCs."""
    source = RecordedSource(path)

    def call() -> int:
        source.seek(source.first_frame)
        blocks = source.frames // TAU
        for _ in range(blocks):
            source.take(0, TAU)
        return blocks * TAU

    return call


def mcap_reader(path: Path, frames: int, *, arrays: bool) -> Callable[[], int]:
    """A call that gives every frame's message with mcap's reader, CRCs checked."""
    out = np.empty((frames, 48 * 128), np.uint8)

    def call() -> int:
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            for i, (_, _, message) in enumerate(reader.iter_messages(topics=["/view/left"])):
                if arrays:
                    end = len(message.data) - 6
                    out[i] = np.frombuffer(message.data, np.uint8)[end - 6144 : end]
        return frames

    return call


def chunks_of(path: Path) -> list[tuple[bytes, int]]:
    """The compressed records of every chunk, and their size once decompressed."""
    with path.open("rb") as file:
        records = StreamReader(file, emit_chunks=True).records
        return [(r.data, r.uncompressed_size) for r in records if isinstance(r, Chunk)]


def decompression(path: Path, frames: int) -> Callable[[], int]:
    """A call that reads the file's chunks and decompresses them, and does nothing else."""
    zstd = zstandard.ZstdDecompressor()

    def call() -> int:
        for stored, size in chunks_of(path):
            zstd.decompress(stored, max_output_size=size)
        return frames

    return call


def decompression_in_memory(path: Path, frames: int) -> Callable[[], int]:
    """A call that decompresses chunks that are in memory already."""
    chunks, zstd = chunks_of(path), zstandard.ZstdDecompressor()

    def call() -> int:
        for stored, size in chunks:
            zstd.decompress(stored, max_output_size=size)
        return frames

    return call


def copying(frames: int) -> Callable[[], int]:
    """A call that copies as many bytes, a block at a time."""
    source, target = np.ones((TAU, 6144), np.uint8), np.empty((TAU, 6144), np.uint8)

    def call() -> int:
        for _ in range(frames // TAU):
            np.copyto(target, source)
        return frames

    return call


def main(*, quick: bool = False, full: bool = False) -> None:
    """Measure, and write results/reader.json; with `full` a recording of 10 GB, too."""
    if full:
        long_recordings.main(full=True)
    rounds, noisy = (3, 400) if quick else (9, 2000)
    with tempfile.TemporaryDirectory() as folder:
        cases = {
            "sample log": SAMPLE / "left.mcap",
            "noisy pictures": write_pictures(Path(folder), noisy),
        }
        rows = []
        for name, path in cases.items():
            frames = RecordedSource(path).frames
            work = {
                "cdmisfa": ours(path),
                "mcap": mcap_reader(path, frames, arrays=False),
                "mcap to arrays": mcap_reader(path, frames, arrays=True),
                "decompression": decompression(path, frames),
                "in memory": decompression_in_memory(path, frames),
                "memcpy": copying(frames),
            }
            times = interleaved(work, rounds)
            mine = times["cdmisfa"]
            shares = [ratio(times[k], mine) for k in ("decompression", "in memory", "memcpy")]
            rows.append(
                [name, round(frames * 6144 / path.stat().st_size, 1)]
                + [round(statistics.median(mine), 2)]
                + [f"{ratio(times[k], mine):.1f}x" for k in ("mcap", "mcap to arrays")]
                + [f"{100 * share:.0f} %" for share in shares]
            )
    header = [
        "file",
        "compressed",
        "us a frame",
        "vs mcap",
        "vs mcap to arrays",
        "of decompression's speed",
        "of decompression in memory",
        "of memcpy",
    ]
    save(
        "reader",
        "Reading a recording",
        "Blocks of 40 frames (48 x 128) with ground truth, zstd, every CRC checked, one thread. "
        "Decompression is mcap's chunk reader and zstd alone, without a checksum; in memory, "
        "zstd alone.",
        [(header, rows)],
    )
