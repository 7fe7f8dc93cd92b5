"""Recording against rendering alone, and with two processes."""

from __future__ import annotations

import contextlib
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.report import interleaved, ratio, save
from recorder.recording import record
from recorder.rendering import render_here, requests
from recorder.scenes import open_scene


def rendering(scene: str, frames: int) -> Callable[[], int]:
    """A call that opens a scene and renders every view's frames."""

    def call() -> int:
        with contextlib.closing(open_scene(scene)) as source:
            wanted = requests(dict.fromkeys(range(len(source.spec.streams)), 0), frames)
            return sum(len(block.frames) for block in render_here(source, wanted))

    return call


def recording(scene: str, frames: int, folder: Path, jobs: int) -> Callable[[], int]:
    """A call that records every view's frames."""

    def call() -> int:
        record(scene, folder / f"jobs{jobs}", frames=frames, jobs=jobs, force=True)
        return 3 * frames

    return call


def main(*, quick: bool = False, full: bool = False, scene: str = "icub") -> None:
    """Measure, and write results/recorder.json."""
    rounds, frames = (2, 40) if quick else (3, 400)
    with tempfile.TemporaryDirectory() as folder:
        work = {
            "rendering": rendering(scene, frames),
            "recording": recording(scene, frames, Path(folder), 1),
        }
        times = interleaved(work, rounds, time.process_time_ns)
        both = {
            "1 job": recording(scene, 10 * frames, Path(folder), 1),
            "2 jobs": recording(scene, 10 * frames, Path(folder), 2),
        }
        walls = interleaved(both, 1, time.perf_counter_ns)
    share = ratio(times["rendering"], times["recording"])
    rows = [
        ["rendering alone, CPU", round(statistics.median(times["rendering"])), ""],
        ["recording, CPU", round(statistics.median(times["recording"])), f"{100 * share:.0f} %"],
        ["1 job, wall", round(statistics.median(walls["1 job"])), ""],
        [
            "2 jobs, wall",
            round(statistics.median(walls["2 jobs"])),
            f"{ratio(walls['1 job'], walls['2 jobs']):.2f}x",
        ],
    ]
    save(
        "recorder",
        "Recording",
        f"{frames} frames of each of three views of the scene {scene}, opening the scene "
        "included. The share is the frame rate of recording over that of rendering alone; two "
        "jobs are compared on ten times as many frames by the wall's clock, which counts starting "
        "them and whatever else runs.",
        [(["what", "us a frame", "ratio"], rows)],
    )
