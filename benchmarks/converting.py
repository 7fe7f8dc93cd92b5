"""Converting external logs into recordings, against decoding the same frames alone."""

from __future__ import annotations

import contextlib
import itertools
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from PIL import Image

from benchmarks import foreign
from benchmarks.report import interleaved, middle, save
from benchmarks.report import ratio as times_ratio
from recorder.images.options import InputOptions
from recorder.recording import record
from recorder.world.scenes import BLOCK
from replay.open_sources import open_external

RATE = 30.0


def write_folder(folder: Path, n: int) -> Path:
    """PNG files of 640x480."""
    folder.mkdir()
    for i, image in enumerate(foreign.pictures(n, *foreign.VGA)):
        Image.fromarray(image).save(folder / f"{i}.png", compress_level=1)
    return folder


def write_video(path: Path, n: int) -> Path:
    """A video of 640x480, H.264."""
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=int(RATE))
        stream.width, stream.height, stream.pix_fmt = 640, 480, "yuv420p"
        for image in foreign.pictures(n, *foreign.VGA):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="gray")))
        container.mux(stream.encode())
    return path


def decoding(path: Path) -> int:
    """Open a log and take all of its frames as converting does; how many."""
    with contextlib.closing(open_external(path, InputOptions(rate=RATE))) as source:
        left = source.frames
        while left:
            left -= len(source.take(0, min(left, BLOCK)))
        return source.frames


def converting(path: Path, folder: Path) -> Callable[[], int]:
    """A call that converts a log into a new folder, with all that the command does of it."""
    numbers = itertools.count()

    def call() -> int:
        out = folder / str(next(numbers))
        with contextlib.closing(open_external(path, InputOptions(rate=RATE))) as source:
            count = sum(file.frames for file in record(source, out))
        shutil.rmtree(out)
        return count

    return call


def main(*, quick: bool = False) -> None:
    """Measure, and write results/converting.json."""
    rounds, n = (2, 60) if quick else (5, 400)
    rows = []
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        logs = {
            "MCAP, JPEG": foreign.write(folder / "a.mcap", foreign.CASES["JPEG 640x480, none"], n),
            "MCAP, mono8, zstd": foreign.write(
                folder / "b.mcap", foreign.CASES["mono8 640x480, zstd"], n
            ),
            "folder of PNG": write_folder(folder / "png", n),
            "video, H.264": write_video(folder / "c.mp4", n),
        }
        for name, path in logs.items():
            work = {
                "decoding": lambda path=path: decoding(path),
                "converting": converting(path, folder / "out"),
            }
            row: list[object] = [name]
            for clock in (time.process_time_ns, time.perf_counter_ns):
                times = interleaved(work, rounds, clock)
                share = 100 * times_ratio(times["decoding"], times["converting"])
                row += [middle(times["decoding"], 1), middle(times["converting"], 1)]
                row.append(f"{share:.0f} %")
            rows.append(row)
    ours = ["decoding, µs", "converting, µs", "share"]
    header = ["log", *(f"CPU: {part}" for part in ours), *(f"wall: {part}" for part in ours)]
    save(
        "converting",
        "Convert a log",
        f"{n} images of 640x480 to frames of 80x60: decoding and scaling alone, and the "
        "complete conversion with checksums. Share: speed of converting relative to decoding "
        "alone.",
        [(header, rows)],
    )
