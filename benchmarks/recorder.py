"""Recording against rendering alone, and with two processes."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.recordings import VIEWS
from benchmarks.report import interleaved, ratio, save
from recorder.config import RecordConfig, SceneConfig
from recorder.recording import record
from recorder.scenes import open_scene


def rendering(scene: str, frames: int) -> Callable[[], int]:
    """A call that opens a scene and renders every view's frames."""

    def call() -> int:
        done = 0
        for view in range(len(VIEWS)):
            source = open_scene(scene, SceneConfig(), RecordConfig())
            for at in range(0, frames, 40):
                source.take(view, min(40, frames - at))
                done += min(40, frames - at)
            source.close()
        return done

    return call


def recording(scene: str, frames: int, folder: Path, jobs: int) -> Callable[[], int]:
    """A call that records every view's frames."""

    def call() -> int:
        record(scene, folder / f"jobs{jobs}", frames=frames, jobs=jobs, force=True)
        return frames * len(VIEWS)

    return call


def main(*, quick: bool = False, full: bool = False, scene: str = "icub") -> None:
    """Measure, and write results/recorder.json."""
    rounds, frames = (2, 40) if quick else (5, 160)
    with tempfile.TemporaryDirectory() as folder:
        work = {
            "rendering": rendering(scene, frames),
            "recording": recording(scene, frames, Path(folder), 1),
        }
        times = interleaved(work, rounds, time.process_time_ns)
        both = {
            "1 job": recording(scene, frames, Path(folder), 1),
            "2 jobs": recording(scene, frames, Path(folder), 2),
        }
        walls = interleaved(both, rounds, time.perf_counter_ns)
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
        "jobs are compared by the wall's clock, and so suffer from whatever else runs.",
        [(["what", "us a frame", "ratio"], rows)],
    )
