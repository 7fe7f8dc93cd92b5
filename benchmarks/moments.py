"""What keyframes take of a run's time and log, and what going to a moment takes with them."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from benchmarks.report import SAMPLE, save
from cdmisfa.core.blocks import Block
from cdmisfa.core.learning import Learner
from cdmisfa.core.signals import BlockSignals
from cdmisfa.experiments import session
from cdmisfa.experiments.loop import Keyframes
from cdmisfa.experiments.resume import Recomputation
from cdmisfa.experiments.run_folder import command_of
from cdmisfa.experiments.sources import open_source
from recorder.mcap.reader import LogReader
from replay.runs.folders import run_log
from replay.runs.keyframes import KEYFRAME_TOPIC

FRAMES = 60_000
MOMENTS = 15

SOURCES: Mapping[str, dict[str, Any]] = {str(SAMPLE): {"loop": True}, "oscillatory": {}}
"""Sources, and how each is opened."""

NAMES = {str(SAMPLE): "sample log", "oscillatory": "oscillatory streams"}

CASES = {"the last alone": 0, "as they come": None, "every 100": 100}
"""Iterations between keyframes."""


class Timed(Keyframes):
    """Keyframes that count the time that they take, without that of what they flush before.

    That would be written without them, too, a little later.
    """

    spent = 0

    def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
        """See `Sink`."""
        if not self._every or learner.iteration % self._every:
            super().block(block, signals, learner)
            return
        self._log.flush()
        begin = time.process_time_ns()
        super().block(block, signals, learner)
        Timed.spent += time.process_time_ns() - begin

    def finish(self) -> None:
        """See `Sink`."""
        self._log.flush()
        begin = time.process_time_ns()
        with mock.patch.object(self._log, "sync"):  # is of the log, which has to be on disk
            super().finish()
        Timed.spent += time.process_time_ns() - begin
        self._log.sync()


def learning(word: str, out: Path, keyframes: int | None, frames: int) -> Callable[[], int]:
    """A call that learns from a source into a log, and gives the iterations."""

    def call() -> int:
        how = SOURCES[word]
        source, configuration = open_source([word], **how)
        iterations = frames // configuration.learner.tau
        session.run_session(
            source,
            configuration.learner,
            out,
            sections=configuration.tables(),
            command=command_of((word,), how, out),
            max_iterations=iterations,
            max_modules=iterations,
            keyframes=keyframes,
            force=True,
            rerun=False,
        )
        source.close()
        return iterations

    return call


def timed(call: Callable[[], int]) -> tuple[float, float]:
    """Microseconds of CPU that an iteration takes, and the part of it that keyframes take."""
    Timed.spent, begin = 0, time.process_time_ns()
    with mock.patch.object(session, "Keyframes", Timed):
        iterations = call()
    took = time.process_time_ns() - begin
    return took / 1000 / iterations, Timed.spent / took


def share(out: Path) -> tuple[int, float]:
    """Return the number of keyframes of a log, and their share of its bytes."""
    log = run_log(out)
    with LogReader(log) as reader:
        numbers = {n for n, channel in reader.channels.items() if channel.topic == KEYFRAME_TOPIC}
        counts = [(s.stored, numbers & (s.channel_counts() or {}).keys()) for s in reader.segments]
    sizes = [stored for stored, keyframes in counts if keyframes]
    return len(sizes), sum(sizes) / log.stat().st_size


def moments(out: Path, iterations: int) -> list[float]:
    """Seconds of CPU to go to each of some moments, the least of three times."""
    chosen = np.random.default_rng(0).integers(0, iterations, MOMENTS).tolist()
    Recomputation.after(out, iterations - 1)  # imports what it needs
    return [min(_seconds(out, at) for _ in range(3)) for at in chosen]


def _seconds(out: Path, at: int) -> float:
    begin = time.process_time()
    Recomputation.after(out, at)
    return time.process_time() - begin


def main(*, quick: bool = False) -> None:
    """Measure, and write results/moments.json."""
    rows: list[list[Any]] = []
    frames = FRAMES // 50 if quick else FRAMES
    with tempfile.TemporaryDirectory() as folder:
        for word, name in NAMES.items():
            work = {
                case: learning(word, Path(folder) / name / case, keyframes, frames)
                for case, keyframes in CASES.items()
            }
            iterations = {case: call() for case, call in work.items()}  # all is imported now
            rounds = [
                {c: timed(call) for c, call in work.items()} for _ in range(1 if quick else 5)
            ]
            for case, count in iterations.items():
                out = Path(folder) / name / case
                many, part = share(out)
                took = statistics.median(times[case][0] for times in rounds)
                spent = statistics.median(times[case][1] for times in rounds)
                percent = [f"{100 * value:.1f} %" for value in (spent, part)]
                durations = moments(out, count)
                seconds = f"{statistics.median(durations):.3f} ({max(durations):.3f})"
                rows.append([name, case, many, round(took), *percent, seconds])
    head = ["run", "keyframes", "how many", "µs an iteration", "of that", "of run.mcap"]
    save(
        "moments",
        "Any iteration of a run",
        f"Runs of {frames:,} frames of CD-MISFA 2.0 with a log: CPU time of all threads, the "
        "share that keyframes take, and the time to restore an iteration (open log and "
        "source, load the keyframe before it, learn up to it): median and maximum of "
        f"{MOMENTS} random iterations.",
        [([*head, "CPU s to a moment"], rows)],
    )
