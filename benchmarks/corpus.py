"""The index of many logs: made, and brought up to date."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.report import interleaved, middle, ratio, save
from recorder.mcap.reader import LogReader
from recorder.recording import record_scene
from replay.integrity.info import describe_reader

FRAMES = 1000
MADE = 20
"""Recordings that are made; the others are links to their files."""

Cost = tuple[float, float, float]
"""Seconds by the wall's clock and of all processors, and peak of memory of one process in MB."""


def write_corpus(folder: Path, recordings: int) -> None:
    """Make so many recordings of three views each, a folder each."""
    for number in range(min(MADE, recordings)):
        record_scene("oscillatory", folder / f"rec-{number:05d}", frames=FRAMES + number)
    for number in range(MADE, recordings):
        copy = folder / f"rec-{number:05d}"
        copy.mkdir()
        for log in (folder / f"rec-{number % MADE:05d}").glob("*.mcap"):
            os.link(log, copy / log.name)


def cost_of(*words: object) -> Cost:
    """Run a command of its own."""
    command = [sys.executable, "-m", "cdmisfa", *map(str, words)]
    with tempfile.TemporaryDirectory() as hidden:
        (Path(hidden) / "pandas.py").write_text("raise ImportError")
        environment = {**os.environ, "PYTHONPATH": hidden}
        start = time.perf_counter()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=environment)
        _, status, used = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - start
    if status:
        raise SystemExit(f"cdmisfa {' '.join(map(str, words))} failed")
    return seconds, used.ru_utime + used.ru_stime, used.ru_maxrss / 1000


def commands(folder: Path, recordings: int) -> list[list[object]]:
    """What commands take on that many small recordings."""
    write_corpus(folder, recordings)
    work: list[tuple[str, tuple[object, ...]]] = [
        ("index, first time", ("index", folder, "--jobs", 2)),
        ("index, nothing changed", ("index", folder)),
        ("--version (start-up alone)", ("--version",)),
    ]
    rows: list[list[object]] = []
    for name, words in work:
        seconds, busy, peak = cost_of(*words)
        rows.append([name, recordings, round(seconds, 2), round(busy, 2), round(peak)])
    return rows


def per_file(folder: Path, rounds: int) -> list[object]:
    """CPU of a file's row by its summary, and by decoding it, in milliseconds."""
    log = next((folder / "rec-00000").glob("*.mcap"))

    def work(decode: bool) -> Callable[[], int]:
        def call() -> int:
            with LogReader(log, skip_damaged=True, check="pass" if decode else "chunks") as reader:
                describe_reader(reader, decode=decode)
            return 1

        return call

    times = interleaved({"summary": work(False), "decoding": work(True)}, rounds)
    each = [middle(times[name]) / 1000 for name in ("summary", "decoding")]
    return [*(round(one, 2) for one in each), f"{ratio(times['decoding'], times['summary']):.1f}x"]


def main(*, quick: bool = False) -> None:
    """Measure, and write results/corpus.json."""
    with tempfile.TemporaryDirectory() as folder:
        rows = commands(Path(folder), 100 if quick else 2000)
        files = per_file(Path(folder), 20 if quick else 100)
    save(
        "corpus",
        "Index of many logs",
        f"Index recordings of three views and {FRAMES} frames each. Wall time and CPU time of "
        "whole processes, and the peak memory of the largest one. pandas is not installed; "
        "where it is, pyarrow imports it (about 1 s of CPU). Second table: one file by its "
        "summary, and by decoding all frames.",
        [
            (["command", "recordings", "seconds, wall", "seconds, CPU", "peak MB"], rows),
            (["by its summary, ms", "by decoding, ms", "ratio"], [files]),
        ],
    )
