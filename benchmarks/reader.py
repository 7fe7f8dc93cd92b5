"""Reading a recording into blocks, against mcap's reader and decompression alone."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import zstandard
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from numpy.typing import NDArray

from benchmarks import long_recordings
from benchmarks.report import SAMPLE, interleaved, middle, ratio, save
from replay.open_sources import open_recording

TAU = 40


def noisy_pictures(n: int) -> NDArray[np.uint8]:
    """Pictures of slow waves with some noise, (n, 48, 128), which shrink to about a fifth."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[0:48, 0:128]
    frames = np.empty((n, 48, 128), np.uint8)
    for t in range(n):
        wave = 128 + 90 * np.sin(x / 17 + t / 40) * np.cos(y / 11 - t / 70)
        noise = rng.random((48, 128)) < 0.08
        frames[t] = wave // 8 * 8 + noise * 4
    return frames


def ours(path: Path) -> Callable[[], int]:
    """A call that plays a file in blocks of 40 frames, with its ground truth and all CRCs."""
    source = open_recording(path)

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


def decompression(path: Path, frames: int, *, in_memory: bool) -> Callable[[], int]:
    """A call that decompresses the file's chunks and does nothing else, but for reading them."""
    zstd = zstandard.ZstdDecompressor()

    def chunks() -> Iterator[tuple[bytes, int]]:
        with path.open("rb") as file:
            for record in StreamReader(file, emit_chunks=True).records:
                if isinstance(record, Chunk):
                    yield record.data, record.uncompressed_size

    stored_chunks = list(chunks()) if in_memory else None

    def call() -> int:
        for stored, size in stored_chunks or list(chunks()):
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


def main(*, quick: bool = False) -> None:
    """Measure, and write results/reader.json."""
    rounds, noisy = (3, 400) if quick else (9, 2000)
    with tempfile.TemporaryDirectory() as folder:
        cases = {
            "sample log": SAMPLE / "left.mcap",
            "noisy pictures": long_recordings.write(Path(folder), noisy_pictures(noisy)),
        }
        rows = []
        for name, path in cases.items():
            frames = open_recording(path).frames
            work = {
                "cdmisfa": ours(path),
                "mcap": mcap_reader(path, frames, arrays=False),
                "mcap to arrays": mcap_reader(path, frames, arrays=True),
                "decompression": decompression(path, frames, in_memory=False),
                "in memory": decompression(path, frames, in_memory=True),
                "memcpy": copying(frames),
            }
            times = interleaved(work, rounds, time.process_time_ns)
            mine = times["cdmisfa"]
            shares = [ratio(times[k], mine) for k in ("decompression", "in memory", "memcpy")]
            rows.append(
                [name, round(frames * 6144 / path.stat().st_size, 1)]
                + [middle(mine, 2)]
                + [f"{ratio(times[k], mine):.1f}x" for k in ("mcap", "mcap to arrays")]
                + [f"{100 * share:.0f} %" for share in shares]
            )
    header = ["file", "compressed", "µs a frame", "vs mcap", "vs mcap to arrays"]
    header += ["of decompression's speed", "of decompression in memory", "of memcpy"]
    save(
        "reader",
        "Reading a recording",
        "Blocks of 40 frames (48 x 128) with ground truth, zstd, every CRC checked, CPU time "
        'of all threads. "Decompression" is mcap\'s chunk reader and zstd without '
        "checksums; in memory, zstd alone.",
        [(header, rows)],
    )
