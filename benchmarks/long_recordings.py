"""What reading takes, of a recording of 100 MB and of one a hundred times as long."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.report import save
from cdmisfa.core.blocks import Block, SourceSpec
from recorder.config import RecordConfig
from recorder.log.files import partial_path
from recorder.log.manifest import RecordingSpec
from recorder.log.viewlog import ViewLog

SHAPE = (240, 320)
TAU = 40
MEGABYTE = 10**6


def write(folder: Path, frames: NDArray[np.uint8], *, size: int = 0, **keys: str) -> Path:
    """Record frames as one view, again and again until its file has `size` bytes; the file."""
    spec = SourceSpec(("left",), frames.shape[1:], "uint8", ("x", "y"), 50.0, 10**18)
    log = ViewLog(folder, "left", RecordingSpec("plain", 0, spec, {}), RecordConfig(**keys))
    file = folder / "left.mcap"
    while not log.t or partial_path(file).stat().st_size < size:
        log.write(Block(0, log.t, frames, np.zeros((len(frames), 2))))
    log.finish()
    return file


def write_long(folder: Path, size: int) -> Path:
    """Record about `size` bytes, uncompressed: a plain image with a line that moves."""
    folder.mkdir(parents=True, exist_ok=True)
    frames = np.full((TAU, *SHAPE), 100, np.uint8)
    frames[np.arange(TAU), np.arange(TAU)] = 200
    return write(folder, frames, size=size, compression="none")


def first_frames(path: Path) -> None:
    """Open a recording and take its first block."""
    from replay.open_sources import open_recording

    with contextlib.closing(open_recording(path)) as source:
        source.take(0, TAU)


def play(path: Path) -> None:
    """Take every block of a recording."""
    from replay.open_sources import open_recording

    with contextlib.closing(open_recording(path)) as source:
        for _ in range(source.frames // TAU):
            source.take(0, TAU)


def messages(path: Path) -> None:
    """Go over every message of a log."""
    from recorder.mcap.reader import LogReader

    with LogReader(path) as reader:
        for _ in reader.messages():
            pass


def info(path: Path) -> None:
    """Describe a log."""
    from replay.integrity.info import describe

    describe(path)


def verify(path: Path) -> None:
    """Check all of a log."""
    from replay.integrity.verify import check_log

    if not check_log(path).ok:
        raise SystemExit(f"{path} is damaged")


WORK: dict[str, Callable[[Path], None]] = {
    work.__name__.replace("_", " "): work for work in (first_frames, play, messages, info, verify)
}


def measured(work: str, path: Path) -> tuple[float, float, float]:
    """Do some work in a process of its own: seconds, peak of memory and bytes read in MB."""
    words = [sys.executable, "-m", "benchmarks.long_recordings", work, str(path)]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    seconds, peak, read = map(float, done.stdout.split())
    return seconds, peak, read


def main(*, quick: bool = False) -> None:
    """Measure, and write results/long_recordings.json."""
    short, long = 50, 100 if quick else 500
    rows: dict[str, list[object]] = {work: [work] for work in WORK}
    for size in (short, long):
        with tempfile.TemporaryDirectory() as folder:
            path = write_long(Path(folder), size * MEGABYTE)
            for work in WORK:
                seconds, peak, read = measured(work, path)
                share = f"{read / (path.stat().st_size / MEGABYTE):.3f}x"
                rows[work] += [round(seconds, 2), round(peak), share]
    header = ["work"]
    for size in (short, long):
        header += [f"{size} MB: seconds", f"{size} MB: peak MB"]
        header += [f"{size} MB: part read"]
    save(
        "long_recordings",
        "Memory for long recordings",
        f"A recording of one view ({SHAPE[0]} x {SHAPE[1]} pixels, uncompressed). Peak memory "
        "of a process for each kind of work, Python and libraries included, and the part of "
        "the file that it reads. Small recordings are read first, so that imports are not "
        "counted in seconds and bytes.",
        [(header, list(rows.values()))],
    )


def _one(work: str, path: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        WORK[work](write_long(Path(folder), MEGABYTE))  # imports what it needs
    bytes_before, before = bytes_read(), time.perf_counter()
    WORK[work](path)
    seconds, read = time.perf_counter() - before, bytes_read() - bytes_before
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    peak = next(line for line in status.splitlines() if line.startswith("VmHWM"))
    print(seconds, int(peak.split()[1]) / 1000, read / MEGABYTE)


def bytes_read(who: str = "self") -> int:
    """Bytes that this process, or `thread-self`, has read so far."""
    return int(Path(f"/proc/{who}/io").read_text(encoding="utf-8").split()[1])


if __name__ == "__main__":
    _one(sys.argv[1], Path(sys.argv[2]))
