"""An iteration of the preset icub by its parts, and what it takes to write it down."""

from __future__ import annotations

import contextlib
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

from benchmarks.report import SAMPLE, ratio, save
from cdmisfa import kernels
from cdmisfa.agents.learner import CuriousLearner
from cdmisfa.core.config import LearnerConfig, load_preset
from cdmisfa.core.signals import SignalsHash
from cdmisfa.features.incsfa import IncrementalFeature
from recorder.log.messages import ImageEncoder
from recorder.mcap.writer import McapWriter
from replay.recordings.source import RecordedSource
from replay.runs import writer
from replay.runs.writer import RunWriter

CONFIG = LearnerConfig(**load_preset("icub")["learner"])

PARTS: dict[str, tuple[Any, tuple[str, ...]]] = {
    "reading": (RecordedSource, ("take",)),
    "IncSFA": (IncrementalFeature, ("update",)),
    "projecting": (kernels, ("outputs", "mean_output")),
    "gate": (kernels, ("recognise",)),
    "policy": (kernels, ("think",)),
    "signals": (CuriousLearner, ("_signals",)),
    "digest": (SignalsHash, ("add",)),
}
"""Of an iteration: where the functions are that do it."""

LOG_PARTS: dict[str, tuple[Any, tuple[str, ...]]] = {
    "encoding signals": (writer, ("encode_signals",)),
    "encoding pictures": (ImageEncoder, ("__call__",)),
    "encoding truth, weights": (writer, ("encode_matrix",)),
    "keeping messages": (McapWriter, ("add_messages",)),
}
"""The same of its log."""

APART = patch.object(CuriousLearner, "kernel", None)

Times = dict[str, float]


@contextlib.contextmanager
def timed(parts: dict[str, tuple[Any, tuple[str, ...]]], times: Times) -> Iterator[None]:
    """Add the CPU time that parts take in this thread, in nanoseconds, to `times`."""

    def counted(part: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def counting(*args: Any, **kwargs: Any) -> Any:
            start = time.thread_time_ns()
            try:
                return call(*args, **kwargs)
            finally:
                times[part] += time.thread_time_ns() - start

        return counting

    with contextlib.ExitStack() as patched:
        for part, (place, names) in parts.items():
            for name in names:
                new = counted(part, getattr(place, name))
                patched.enter_context(patch.object(place, name, new))
        yield


def measured(rounds: int, iterations: int) -> dict[str, list[float]]:
    """Microseconds an iteration by part, one entry a round; `all` and `log` are wholes.

    The learner calls the parts of an iteration one by one, as it does for a feature in Python; else
    one call of C does all of them.
    """
    found: dict[str, list[float]] = defaultdict(list)
    clock = time.thread_time_ns
    for turn in range(rounds + 1):
        source, times = RecordedSource(SAMPLE, loop=True), defaultdict[str, float](float)
        learner, digest = CuriousLearner(CONFIG, source.spec, 0), SignalsHash()
        with tempfile.TemporaryDirectory() as folder, timed({**PARTS, **LOG_PARTS}, times), APART:
            log = RunWriter(Path(folder) / "run.mcap", source.spec, {})
            for _ in range(iterations):
                begin = clock()
                block = source.take(learner.stream, learner.tau)
                signals = learner.step(block)
                digest.add(signals)
                learned = clock()
                log.block(block, signals, learner)
                times["log"] += clock() - learned
                times["all"] += learned - begin
            log.finish()
        for part in ("all", *PARTS, "log", *LOG_PARTS) if turn else ():
            found[part].append(times[part] / 1000 / iterations)
    return dict(found)


def table(times: dict[str, list[float]], whole: str, parts: list[str]) -> list[list[Any]]:
    """Rows: part, share of an iteration without a log."""
    each = list(zip(*(times[part] for part in parts), strict=True))
    rest = [all_of_it - sum(row) for all_of_it, row in zip(times[whole], each, strict=True)]
    rows = {**{part: times[part] for part in parts}, "all else": rest, "together": times[whole]}
    return [[name, f"{100 * ratio(part, times['all']):.1f} %"] for name, part in rows.items()]


def main(*, quick: bool = False, full: bool = False) -> None:
    """Measure, and write results/iteration.json."""
    rounds, iterations = (4, 100) if quick else (9, 1000)
    times = measured(rounds, iterations)
    save(
        "iteration",
        "An iteration by its parts",
        f"Of the preset icub (K = {CONFIG.components}, {CONFIG.tau} frames of the sample log, 48"
        f" x 128 pixels): CPU time of the learning thread, the median of {rounds} runs of "
        f"{iterations} iterations, the clock included that is asked before and after each part. "
        "The learner's parts are called one by one here, else one call of C does all of them. "
        "The second table is of run.mcap, whose chunks are compressed in a thread of their own,"
        " and in shares of an iteration without a log. What limits an iteration: reading is "
        "zstd (50 us a chunk where nothing else runs, 1.1 chunks an iteration) and the checksum"
        " of the chunk (6 us); decompressing the next chunk in a thread took no time off the "
        "learning thread, which holds the interpreter, and added a fifth to that of all "
        "threads. Projecting converts pixels to doubles; the digest is the getting of 42 "
        "signals (SHA-256 itself takes 0.7 us), which takes 8 us in a loop of its own and "
        "two or three times that here, because frames and vectors have driven all else out of "
        "the CPU's cache; a log's part takes 17 us in a loop, 40 to 55 here, and what comes after "
        "it is 10 us dearer. Digests and messages of 8 or 24 iterations at once take no less: "
        "their records have left the cache by then. To copy the pictures takes 3 us. Of a log, "
        "LZ4 takes 10 us an iteration in the other thread, all else there 9.",
        [
            (["part", "of it"], table(times, "all", list(PARTS))),
            (
                ["part of its log", "of no log"],
                table(times, "log", [*LOG_PARTS]),
            ),
        ],
    )
