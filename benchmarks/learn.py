"""Learning from a recorded log without a log, with run.mcap, and with run.mcap and run.rrd."""

from __future__ import annotations

import gc
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.report import SAMPLE, middle, ratio, save
from cdmisfa.core.config import LearnerConfig, load_preset
from cdmisfa.experiments.session import run_session
from replay.open_sources import open_recording

CONFIGS = {
    "preset icub": LearnerConfig(**load_preset("icub")["learner"]),
    "K = 32, J = 5": LearnerConfig(components=32, outputs=5, nu=0.005, tau=40, expansion="none"),
}
CLOCKS = {"learning thread": time.thread_time_ns, "all threads": time.process_time_ns}

Times = dict[tuple[str, str], list[float]]
"""By clock and logs: microseconds of CPU, one entry a round."""


def learning(config: LearnerConfig, out: Path | None, *, rerun: bool) -> Callable[[int], None]:
    """A call that learns from the sample log for some iterations."""
    source = open_recording(SAMPLE, loop=True)

    def call(iterations: int) -> None:
        source.seek(0)
        run_session(source, config, out, max_iterations=iterations, force=True, rerun=rerun)

    return call


def timed(call: Callable[[int], None], iterations: int) -> dict[str, float]:
    """Microseconds of CPU, by clock."""
    gc.collect()
    begin = {name: clock() for name, clock in CLOCKS.items()}
    call(iterations)
    return {name: (clock() - begin[name]) / 1000 for name, clock in CLOCKS.items()}


def table(config: LearnerConfig, rounds: int, short: int, long: int) -> list[list[Any]]:
    """Rows: clock, logs, a whole run, a further iteration, what every run takes."""
    with tempfile.TemporaryDirectory() as folder:
        work = {
            "no log": learning(config, None, rerun=False),
            "run.mcap": learning(config, Path(folder) / "a", rerun=False),
            "run.mcap and run.rrd": learning(config, Path(folder) / "b", rerun=True),
        }
        whole: Times = {(name, what): [] for name in CLOCKS for what in work}
        brief: Times = {(name, what): [] for name in CLOCKS for what in work}
        for turn in range(rounds + 1):
            for what, call in work.items():
                few, many = timed(call, short), timed(call, long)
                for name in CLOCKS if turn else ():  # the first turn warms up
                    whole[name, what].append(many[name])
                    brief[name, what].append(few[name])
    each = {
        key: [(a - b) / (long - short) for a, b in zip(times, brief[key], strict=True)]
        for key, times in whole.items()
    }
    return [
        [
            name,
            what,
            middle([t / long for t in times]),
            more(times, whole[name, "no log"]),
            middle(each[name, what]),
            more(each[name, what], each[name, "no log"]),
            round(fixed(brief[name, what], each[name, what], short) / 1000),
        ]
        for (name, what), times in whole.items()
    ]


def fixed(brief: list[float], each: list[float], short: int) -> float:
    """What a run takes beyond its iterations, from a short one: a long one's noise is larger."""
    return statistics.median(b - short * e for b, e in zip(brief, each, strict=True))


def main(*, quick: bool = False) -> None:
    """Measure, and write results/learn.json."""
    rounds, short, long = (2, 10, 60) if quick else (5, 10, 1000)
    head = ["CPU of", "logs", "µs an iteration", "increase"]
    head += ["µs a further iteration", "increase", "fixed ms"]
    tables = []
    for name, config in CONFIGS.items():
        rows = table(config, rounds, short, long)
        tables.append(([f"{name}: {head[0]}", *head[1:]], rows))
    save(
        "learn",
        "Learning",
        f"Runs of {long} iterations on the sample log (blocks of 40 frames, 48 x 128 pixels), "
        "with opening and closing all files. CPU time of an iteration, and by how much it "
        "grows when the run is logged (`run.mcap`) and when the Rerun view (`run.rrd`) is "
        'written after the run. The second table is for K = 32, J = 5. "Further iteration" '
        f'and "fixed" follow from runs of {short} iterations in the same round.',
        tables,
    )


def more(times: list[float], than: list[float]) -> str:
    """How much more, as a percentage."""
    return f"{100 * (ratio(times, than) - 1):+.1f} %"
