"""Ten modules applied to logs, against reading these alone, and the delay of live outputs."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.foreign import VGA, pictures
from benchmarks.live_streams import FPS
from benchmarks.report import SAMPLE, interleaved, middle, ratio, save
from cdmisfa.core.config import LearnerConfig
from cdmisfa.experiments.apply import Application, Totals, follow
from cdmisfa.experiments.session import run_session
from cdmisfa.modules import Module
from recorder.images.framing import Recipe
from recorder.images.options import InputOptions
from replay.export.applied import written
from replay.export.frames import write_video
from replay.open_sources import open_arrays, open_log
from replay.runs.modules import save_modules
from replay.stored_source import StoredSource
from replay.view.applied import written_view

MODULES, TAU = 10, 40
OUTPUTS = (1, 8)
"""Outputs of a module: of CD-MISFA 2.0, and of the progress learner."""

FORMS = ("", "parquet", "mcap", "rrd")
"""Output formats; "" writes nothing."""

SHAPE = (48, 128)
FRAMES, FILMED, READ = 4000, 200, 640


def make_run(folder: Path, outputs: int) -> Path:
    """A run with ten modules of random weights."""
    with open_log([SAMPLE], loop=True) as source:
        run_session(
            source, LearnerConfig(tau=TAU, expansion="none"), folder, max_iterations=3, rerun=False
        )
    rng = np.random.default_rng(1)
    band = np.full(outputs, 0.01)
    save_modules(
        folder / "modules.npz",
        [
            Module(
                *(i + 1, "left", 0, 3, rng.standard_normal((outputs, np.prod(SHAPE))) / 40),
                *(np.zeros(np.prod(SHAPE)), band, band, band, np.zeros(3, np.int64)),
                expansion="none",
                frame_shape=SHAPE,
                recipe=Recipe(SHAPE),
            )
            for i in range(MODULES)
        ],
    )
    return folder


def reading(source: StoredSource, frames: int) -> Callable[[], int]:
    """A call that reads frames of every stream."""

    def call() -> int:
        source.seek(0)
        for n in [READ] * (frames // READ) + [frames % READ]:
            if n:
                source.take_all(n)
        return frames * len(source.spec.streams)

    return call


def applying(
    application: Application, source: StoredSource, frames: int, form: str, folder: Path
) -> Callable[[], int]:
    """A call that applies modules to the same frames, and writes what they give."""

    def call() -> int:
        source.seek(0)
        out, about = folder / f"out.{form}", (source.spec, application.modules)
        totals = Totals(*about)
        with contextlib.ExitStack() as stack:
            write: Any = written_view if form == "rrd" else written
            sinks = [stack.enter_context(write(out, *about, force=True))] if form else []
            follow(application.to(source, frames), sinks, totals)
        return totals.frames

    return call


Rows = list[list[object]]


def throughput(folder: Path, rounds: int) -> tuple[Rows, Rows]:
    """Return two tables with a row for each log and number of outputs of a module.

    Returns:
        CPU microseconds a frame, of all threads; frames a second that are read by the wall's
        clock, and the shares of them that are left.
    """
    film = folder / "film.mp4"
    film_source = open_arrays({"cam": np.stack(pictures(FILMED, *VGA))}, InputOptions(size=VGA))
    write_video(film_source, 0, film, lossless=False)
    cpu: Rows = []
    wall: Rows = []
    for outputs in OUTPUTS:
        application = Application(make_run(folder / f"run{outputs}", outputs))
        for name, log, frames in (
            ("recording", str(SAMPLE), FRAMES),
            ("video 640x480", str(film), FILMED),
        ):
            source: Any = application.open([log], loop=name == "recording")
            with contextlib.closing(source):
                work = {"reading": reading(source, frames)}
                work |= {f: applying(application, source, frames, f, folder) for f in FORMS}
                busy = interleaved(work, rounds, time.process_time_ns)
                times = interleaved(work, rounds, time.perf_counter_ns)
            cpu.append([name, outputs, *(middle(busy[form], 1) for form in work)])
            shares = [f"{100 * ratio(times['reading'], times[form]):.0f} %" for form in FORMS]
            wall.append([name, outputs, round(1e6 / middle(times["reading"], 3)), *shares])
    return cpu, wall


def latency(folder: Path, blocks: int) -> list[object]:
    """Return the delay of outputs after the end of their block, in milliseconds."""
    words = [sys.executable, "-m", "benchmarks.live_streams"]
    pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    late = []
    with subprocess.Popen(words, **pipes) as sender:
        port = int(sender.stdout.readline())
        named = [str(folder / f"run{OUTPUTS[-1]}"), f"http://127.0.0.1:{port}/0.mjpg"]
        options = ["--rate", str(FPS), "--frames", str(blocks * TAU), "--to", "stdout"]
        command = [sys.executable, "-m", "cdmisfa", "apply", *named, *options]
        with subprocess.Popen(command, stderr=subprocess.PIPE, **pipes) as process:
            for line in process.stdout:
                now, block = time.time_ns(), json.loads(line)
                late.append((now - block["log_time"] - block["frames"] * 1e9 / FPS) / 1e6)
        sender.stdin.close()
    return [len(late), *(round(float(v), 1) for v in np.percentile(late, [50, 95, 100]))]


def main(*, quick: bool = False) -> None:
    """Measure, and write results/applying.json."""
    with tempfile.TemporaryDirectory() as place:
        rounds = 2 if quick else 5
        cpu, wall = throughput(Path(place), rounds)
        late = latency(Path(place), 5 if quick else 30)
    head = "log", "outputs per module"
    forms = [f"to {form}" if form else "no output" for form in FORMS]
    save(
        "applying",
        "Apply modules to a log",
        "CPU time of a frame (all threads) for ten modules on frames of 128x48: reading "
        'alone, with the modules ("no output"), and with output to a file. Second table: '
        "frames a second by wall time, and the share of the reading speed that remains. "
        "Third: delay of live results after the end of a block.",
        [
            ([*head, "reading, µs", *(f"{form}, µs" for form in forms)], cpu),
            ([*head, "reading, frames/s", *forms], wall),
            (["blocks", "median, ms", "95 %, ms", "maximum, ms"], [late]),
        ],
    )
