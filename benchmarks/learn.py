"""Learning from a recorded log without a log, with run.mcap, and with run.mcap and run.rrd."""

from __future__ import annotations

import gc
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.report import SAMPLE, middle, ratio, save
from cdmisfa.core.config import LearnerConfig
from cdmisfa.experiments.runs import run
from replay.recordings.source import RecordedSource

CONFIG = LearnerConfig(components=32, outputs=5, nu=0.005, tau=40, expansion="none")
CLOCKS = {"learning thread": time.thread_time_ns, "all threads": time.process_time_ns}

Times = dict[tuple[str, str], list[float]]
"""By clock and logs: microseconds of CPU, one entry a round."""


def learning(out: Path | None, *, rerun: bool) -> Callable[[int], None]:
    """A call that learns from the sample log for some iterations."""
    source = RecordedSource(SAMPLE, loop=True)

    def call(iterations: int) -> None:
        source.seek(0)
        run(source, CONFIG, out, max_iterations=iterations, force=True, rerun=rerun)

    return call


def timed(call: Callable[[int], None], iterations: int) -> dict[str, float]:
    """Microseconds of CPU, by clock."""
    gc.collect()
    begin = {name: clock() for name, clock in CLOCKS.items()}
    call(iterations)
    return {name: (clock() - begin[name]) / 1000 for name, clock in CLOCKS.items()}


def main(*, quick: bool = False, full: bool = False) -> None:
    """Measure, and write results/learn.json."""
    rounds, short, long = (2, 20, 60) if quick else (5, 250, 1000)
    with tempfile.TemporaryDirectory() as folder:
        work = {
            "no log": learning(None, rerun=False),
            "run.mcap": learning(Path(folder) / "a", rerun=False),
            "run.mcap and run.rrd": learning(Path(folder) / "b", rerun=True),
        }
        whole: Times = {(name, what): [] for name in CLOCKS for what in work}
        each: Times = {(name, what): [] for name in CLOCKS for what in work}
        for turn in range(rounds + 1):
            for what, call in work.items():
                brief, lengthy = timed(call, short), timed(call, long)
                for name in CLOCKS if turn else ():  # the first turn warms up
                    whole[name, what].append(lengthy[name])
                    each[name, what].append((lengthy[name] - brief[name]) / (long - short))
    rows = []
    for (name, what), times in whole.items():
        steady = each[name, what]
        fixed = [t - long * s for t, s in zip(times, steady, strict=True)]
        rows.append(
            [
                name,
                what,
                middle([t / long for t in times]),
                more(times, whole[name, "no log"]),
                middle(steady),
                more(steady, each[name, "no log"]),
                f"{middle(fixed) / 1000:.0f}",
            ]
        )
    head = ["CPU of", "logs", "us an iteration, whole run", "more than no log"]
    head += ["us a further iteration", "more than no log", "fixed ms"]
    save(
        "learn",
        "Learning with and without logs",
        f"Whole runs of {long} iterations of 40 frames of the sample log (48 x 128 pixels, "
        "K = 32, J = 5), with opening and finishing the files. The view is built after the run, "
        f"in one pass over its log. From runs of {short} iterations in the same round: what a "
        "further iteration takes, and what a run takes however short it is. Importing Rerun "
        "(about 0.6 s of CPU, once a process) is not in it.",
        [(head, rows)],
    )


def more(times: list[float], than: list[float]) -> str:
    """How much more, as a percentage."""
    return f"{100 * (ratio(times, than) - 1):+.1f} %"
