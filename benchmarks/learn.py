"""Learning from a recorded log without a log, with run.mcap, and with run.mcap and run.rrd."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.recordings import SAMPLE
from benchmarks.report import interleaved, ratio, save
from cdmisfa.config import LearnerConfig
from cdmisfa.experiments.run import learn
from replay.recorded import RecordedSource

CONFIG = LearnerConfig(components=32, outputs=5, nu=0.005, tau=40, expansion="none")


def learning(out: Path | None, iterations: int, *, rerun: bool) -> Callable[[], int]:
    """A call that learns from the sample log for some iterations."""
    source = RecordedSource(SAMPLE, loop=True)

    def call() -> int:
        source.seek(0)
        learn(source, CONFIG, out, max_iterations=iterations, force=True, rerun=rerun)
        return iterations

    return call


def main(*, quick: bool = False, full: bool = False) -> None:
    """Measure, and write results/learn.json."""
    rounds, iterations = (2, 40) if quick else (5, 250)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        clocks = {"learning thread": time.thread_time_ns, "all threads": time.process_time_ns}
        for name, clock in clocks.items():
            work = {
                "no log": learning(None, iterations, rerun=False),
                "run.mcap": learning(Path(folder) / "a", iterations, rerun=False),
                "run.mcap and run.rrd": learning(Path(folder) / "b", iterations, rerun=True),
            }
            times = interleaved(work, rounds, clock)
            for what, values in times.items():
                more = 100 * (ratio(values, times["no log"]) - 1)
                median = statistics.median(values)
                rows.append([name, what, round(median), f"{more:+.0f} %"])
    save(
        "learn",
        "Learning with and without logs",
        f"{iterations} iterations of 40 frames of the sample log (48 x 128 pixels, K = 32, "
        "J = 5), whole runs with opening and finishing the files; the view is built after the "
        "run, from its log.",
        [(["CPU of", "logs", "us an iteration", "more than no log"], rows)],
    )
