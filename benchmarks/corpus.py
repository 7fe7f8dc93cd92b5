"""The index of many logs: made, and brought up to date."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest import mock

import numpy as np
import pyarrow as pa

from benchmarks.report import interleaved, middle, ratio, save
from recorder.mcap.reader import LogReader
from recorder.recording import record_scene
from replay.corpus import index as indexing
from replay.corpus.finding import INDEX, Found
from replay.corpus.rows import SCHEMA
from replay.integrity.info import describe_reader

FRAMES = 1000
MADE = 20
"""Recordings that are made; the others are links to their files."""

WITHOUT_PANDAS = "import sys; sys.modules['pandas'] = None; import cdmisfa.cli; cdmisfa.cli.main()"
"""A command as where pandas is not installed, which pyarrow imports where it is."""

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
        ("index, the first time", ("index", folder, "--jobs", 2)),
        ("index, nothing changed", ("index", folder)),
        ("--version, to compare with", ("--version",)),
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
            with LogReader(log, salvage=True, check="pass" if decode else "chunks") as reader:
                describe_reader(reader, decode=decode)
            return 1

        return call

    times = interleaved({"summary": work(False), "decoding": work(True)}, rounds)
    each = [middle(times[name]) / 1000 for name in ("summary", "decoding")]
    return [*(round(one, 2) for one in each), f"{ratio(times['decoding'], times['summary']):.1f}x"]


def made_up(logs: int) -> tuple[pa.Table, list[Found]]:
    """An index of so many logs of three streams that are nowhere, and what would be found."""
    names = [f"rec-{i // 3:06d}/x{i % 3 + 1}.mcap" for i in range(logs)]
    found = [Found(name, 1000 + i, str(10**18 + i)) for i, name in enumerate(names)]
    times = np.repeat(np.arange(logs, dtype=np.int64) * 10**10, 3)
    strings = np.repeat(np.asarray(names), 3)
    own = {
        "path": strings,
        "log": [name[:10] for name in strings],
        "bytes": np.repeat([each.bytes for each in found], 3),
        "changed": np.repeat([each.changed for each in found], 3),
        "number": np.tile(np.arange(3, dtype=np.int32), logs),
        "kind": ["recording"] * 3 * logs,
        "topic": [f"/view/x{i % 3 + 1}" for i in range(3 * logs)],
        "schema": ["cdmisfa.Vector"] * 3 * logs,
        "messages": np.full(3 * logs, 1000),
        "rate": np.full(3 * logs, 50.0),
        "start_ns": times,
        "end_ns": times + 10**9,
        "seconds": np.full(3 * logs, 1.0),
        "identity": [f"{i // 3 % (logs - 1000):064x}" for i in range(3 * logs)],
        "configuration": [f'{{"scene": "icub", "seed": {i % 500}}}' for i in range(3 * logs)],
        "deep": np.zeros(3 * logs, bool),
    }
    columns = [
        pa.array(own[name], kind) if name in own else pa.nulls(3 * logs, kind)
        for name, kind in zip(SCHEMA.names, SCHEMA.types, strict=True)
    ]
    return pa.table(columns, schema=SCHEMA), found


def simulated(folder: Path, recordings: int) -> list[list[object]]:
    """Bring an index of made-up rows up to date, where one of a hundred changed."""
    table, found = made_up(3 * recordings)
    index = folder / INDEX
    indexing.pq.write_table(table, index, compression="zstd")
    changed = [
        one._replace(changed="0", problem="made up") if i % 100 == 0 else one
        for i, one in enumerate(found)
    ]

    def listed(_: object) -> Iterator[Found]:
        return (one._replace(file=f"{folder}/{one.file}") for one in changed)

    def again() -> None:
        with mock.patch.object(indexing, "found_logs", listed):
            made = indexing.index_logs([folder])
        if (made.read, made.logs) != (len(found[::100]), len(found)):
            raise SystemExit(f"{made} is not what was to be done")

    start, busy = time.perf_counter(), time.process_time()
    again()
    cost = time.perf_counter() - start, time.process_time() - busy
    row: list[object] = ["index again, 1 % changed", recordings]
    return [[*row, *(round(one, 3) for one in cost)]]


def main(*, quick: bool = False, full: bool = False) -> None:
    """Measure, and write results/corpus.json."""
    few, many = (100, 5000) if quick else (2000, 100_000)
    with tempfile.TemporaryDirectory() as folder:
        corpus = Path(folder)
        rows = commands(corpus, few)
        files = per_file(corpus, 20 if quick else 100)
    with tempfile.TemporaryDirectory() as folder:
        simulated(Path(folder), 1000)  # imports what it needs
        again = simulated(Path(folder), many)
    save(
        "corpus",
        "The index of many logs",
        f"Recordings of three views and {FRAMES} frames, each a folder of three files. Commands "
        "are processes of their own: seconds by the wall's clock, of all processors, and the peak "
        "of one process, without pandas, which no command needs and pyarrow imports where it is "
        "installed: about a second of CPU. Below, a file's row by its summary and by decoding it, "
        "and a larger index whose rows are made up, brought up to date with real joins, in one "
        "process that has imported all.",
        [
            (["command", "recordings", "seconds", "CPU, seconds", "peak, MB"], rows),
            (["a file by its summary, ms", "by decoding, ms", "ratio"], [files]),
            (["index", "recordings", "seconds", "CPU, seconds"], again),
        ],
    )
