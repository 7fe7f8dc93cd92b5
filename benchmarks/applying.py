"""Ten modules applied to logs, against reading these alone, and how late live blocks are told."""

from __future__ import annotations

import contextlib
import json
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from benchmarks.foreign import VGA, pictures
from benchmarks.live_streams import FPS
from benchmarks.report import SAMPLE, interleaved, middle, ratio, save
from cdmisfa.core.config import LearnerConfig
from cdmisfa.experiments.apply import Application, Totals, follow
from cdmisfa.experiments.session import run
from cdmisfa.modules import Module, Stack
from recorder.cameras.foxglove import HEADER, PROTOCOLS
from recorder.images.recipe import Recipe
from replay.arrays import ArrayLog
from replay.camera_logs.options import CameraOptions
from replay.export.applied import written
from replay.export.frames import write_film
from replay.inputs import open_log
from replay.runs.modules import save_modules
from replay.stored import StoredSource
from replay.view.applied import written_view

MODULES, TAU = 10, 40
OUTPUTS = (1, 8)
"""Outputs of a module: of CD-MISFA 2.0, and of the progress learner."""

FORMS = ("", "parquet", "mcap", "rrd")
"""What is written; "" is nothing."""

SHAPE = (48, 128)
FRAMES, FILMED, READ = 4000, 200, 640
STEP = 1e9 / FPS
"""Nanoseconds from frame to frame of live streams."""


def make_run(folder: Path, outputs: int) -> Path:
    """A run with ten modules of random weights."""
    with open_log([SAMPLE], loop=True) as source:
        run(source, LearnerConfig(tau=TAU, expansion="none"), folder, max_iterations=3, rerun=False)
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
    """Rows of a log and the outputs of a module.

    Returns:
        CPU microseconds a frame, of all threads; frames a second that are read by the wall's
        clock, and the shares of them that are left.
    """
    film = folder / "film.mp4"
    shown = ArrayLog({"cam": np.stack(pictures(FILMED, *VGA))}, CameraOptions(size=VGA))
    write_film(shown, 0, film, lossless=False)
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


def projecting(folder: Path, rounds: int) -> Rows:
    """Rows of the outputs of a module: their product with frames, and numpy's of the same values.

    Returns:
        CPU microseconds a frame of one thread, and how many multiply-adds ours does in one.
    """
    frames = np.random.default_rng(2).integers(0, 255, (READ, np.prod(SHAPE)), np.uint8)
    values, rows = frames / 255, []
    for outputs in OUTPUTS:
        stack = Stack(Application(folder / f"run{outputs}").modules)
        phi = np.concatenate([module.phi for module in stack.modules])
        work: dict[str, Callable[[], int]] = {
            "ours": lambda own=stack: len(own.transform(frames)),
            "numpy": lambda own=phi: len(values @ own.T),
        }
        with threadpool_limits(1):
            times = interleaved(work, 5 * rounds)
        ours = middle(times["ours"], 1)
        against = f"{ratio(times['numpy'], times['ours']):.2f}x"
        rows.append(
            [outputs, ours, middle(times["numpy"], 1), against, round(phi.size / ours / 1000, 1)]
        )
    return rows


def by_lines(command: Any) -> Iterator[float]:
    """How much later a block's line is read than the block lasts, in nanoseconds, of each."""
    for line in command.stdout:
        now, block = time.time_ns(), json.loads(line)
        yield now - block["log_time"] - block["frames"] * STEP


def by_messages(command: Any) -> Iterator[float]:
    """The same of the last module's message of the block's last frame, to a viewer."""
    served = next(line.split()[-1] for line in command.stderr if "applying at" in line)
    how: Any = {"subprotocols": PROTOCOLS, "compression": None}
    with connect(served, **how) as viewer, contextlib.suppress(ConnectionClosed):
        said = (json.loads(message) for message in viewer if isinstance(message, str))
        channels = (channel for one in said for channel in one.get("channels", ()))
        wanted = f"/module{MODULES}/"
        number = next(own["id"] for own in channels if own["topic"].startswith(wanted))
        time.sleep(0.5)  # the server says its channels before it knows them
        subscribed = [{"id": 1, "channelId": number}]
        viewer.send(json.dumps({"op": "subscribe", "subscriptions": subscribed}))
        for message in viewer:
            now = time.time_ns()
            frame = struct.unpack("<q", message[-8:])[0] if isinstance(message, bytes) else 0
            if frame % TAU == TAU - 1:
                yield now - HEADER.unpack_from(message)[2] - STEP


def latency(folder: Path, blocks: int, way: str) -> list[object]:
    """How much later than its own duration after its first frame a block is told, ms."""
    words = [sys.executable, "-m", "benchmarks.live_streams"]
    pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(words, **pipes) as sender:
        port = int(sender.stdout.readline())
        named = [str(folder / f"run{OUTPUTS[-1]}"), f"http://127.0.0.1:{port}/0.mjpg"]
        options = ["--rate", str(FPS), "--frames", str(blocks * TAU), "--to", way]
        command = [sys.executable, "-m", "cdmisfa", "apply", *named, *options]
        served = [*command, "--port", "0"] if way == "foxglove" else command
        with subprocess.Popen(served, stderr=subprocess.PIPE, **pipes) as told:
            found = by_messages(told) if way == "foxglove" else by_lines(told)
            late = [one / 1e6 for one in found]
        sender.stdin.close()
    at = [round(float(value), 1) for value in np.percentile(late, [50, 95, 100])]
    return [way, len(late), *at]


def main(*, quick: bool = False, full: bool = False) -> None:
    """Measure, and write results/applying.json."""
    del full
    with tempfile.TemporaryDirectory() as place:
        rounds = 2 if quick else 5
        cpu, wall = throughput(Path(place), rounds)
        products = projecting(Path(place), rounds)
        late = [latency(Path(place), 5 if quick else 30, way) for way in ("stdout", "foxglove")]
    head = "log", "outputs of a module"
    forms = [f"to {form}" if form else "to nothing" for form in FORMS]
    save(
        "applying",
        "Modules applied to logs",
        "Ten modules applied to frames of 128x48, as `cdmisfa apply` does, with what is written, "
        "against reading the frames alone. First CPU microseconds a frame, of all threads; then, "
        "by the wall's clock, which counts whatever else runs, frames a second of reading, and the "
        "share of them that is left. A recording of ours is read faster than it can be projected: "
        "each output takes 6,144 multiply-adds in double precision a frame, whose sums keep their "
        "order, so that the bits are those of `module.transform`. Then this product alone, of "
        "pixels, against numpy's BLAS of the same frames as float64, of one thread. Last how much "
        "later a block is told than it lasts, counted from the time of its first frame: its JSON "
        "line, or to a viewer the last module's message of its last frame; JPEGs of 640x480 at 30 "
        "Hz over HTTP, ten modules of eight outputs, milliseconds; below 0 where the last frame is "
        "shown before the block's duration is over.",
        [
            (
                ["log", "outputs of a module", "reading, us", *(f"{form}, us" for form in forms)],
                cpu,
            ),
            ([*head, "read, frames a second", *forms], wall),
            (
                [head[1], "product, us", "numpy's, us", "vs numpy", "10^9 multiply-adds a second"],
                products,
            ),
            (["to", "blocks", "median, ms", "95 %, ms", "most, ms"], late),
        ],
    )
