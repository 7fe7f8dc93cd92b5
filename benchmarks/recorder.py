"""Recording against rendering alone, and with two processes."""

from __future__ import annotations

import contextlib
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.report import interleaved, middle, ratio, save
from recorder.recording import record_scene
from recorder.world.scenes import blocks_in_process, open_scene


def rendering(scene: str, frames: int) -> Callable[[], int]:
    """A call that opens a scene and renders every view's frames."""

    def call() -> int:
        with contextlib.closing(open_scene(scene)) as source:
            starts = dict.fromkeys(range(len(source.spec.streams)), 0)
            return sum(len(block.frames) for block in blocks_in_process(source, starts, frames))

    return call


def recording(scene: str, frames: int, folder: Path, jobs: int) -> Callable[[], int]:
    """A call that records every view's frames."""

    def call() -> int:
        record_scene(scene, folder / f"jobs{jobs}", frames=frames, jobs=jobs, force=True)
        return 3 * frames

    return call


def steady_and_start(
    scene: str, frames: int, folder: Path, jobs: int, rounds: int
) -> tuple[float, float]:
    """Return microseconds per frame of a running recorder, and seconds of its start.

    Wall time: from the difference between n and 5 n frames; the rest is the start.
    """
    short, long = recording(scene, frames, folder, jobs), recording(scene, 5 * frames, folder, jobs)
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        few = short()
        between = time.perf_counter()
        many = long()
        ended = time.perf_counter()
        frame = ((ended - between) - (between - start)) / (many - few)
        times.append((1e6 * frame, between - start - few * frame))
    return min(times)


def main(*, quick: bool = False, scene: str = "icub") -> None:
    """Measure, and write results/recorder.json."""
    rounds, frames = (2, 40) if quick else (3, 400)
    more = 100 if quick else 1000
    with tempfile.TemporaryDirectory() as folder:
        work = {
            "rendering": rendering(scene, frames),
            "recording": recording(scene, frames, Path(folder), 1),
        }
        times = interleaved(work, rounds, time.process_time_ns)
        jobs = {n: steady_and_start(scene, more, Path(folder), n, rounds) for n in (1, 2)}
    share = ratio(times["rendering"], times["recording"])
    rows: list[list[object]] = [
        ["rendering alone, CPU", middle(times["rendering"]), "", ""],
        ["recording, CPU", middle(times["recording"]), f"{100 * share:.0f} %", ""],
    ]
    for n, (frame, start) in jobs.items():
        gain = f"{jobs[1][0] / frame:.2f}x" if n > 1 else ""
        rows.append([f"{n} job{'s' * (n > 1)}, wall", round(frame), gain, round(start, 1)])
    save(
        "recorder",
        "Recording a scene",
        f"{frames} frames of each of three views of the scene {scene}, with opening the "
        "scene. Share: speed of recording relative to rendering alone. Jobs are compared by "
        f"wall time: the time of a frame is the difference of recordings of {more} and "
        f"{5 * more} frames, the start is the rest.",
        [(["what", "µs a frame", "ratio", "start, seconds"], rows)],
    )
