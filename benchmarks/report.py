"""Interleaved timing, and results as JSON and Markdown."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import platform
import statistics
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cdmisfa import kernels
from cdmisfa.experiments.documents import markdown

RESULTS = Path(__file__).parent / "results"
SAMPLE = Path(__file__).parent.parent / "sample_logs" / "icub"
PAGE = Path(__file__).parent.parent / "docs" / "evidence" / "benchmarks.md"


def interleaved(
    work: Mapping[str, Callable[[], int]],
    rounds: int,
    clock: Callable[[], int] = time.thread_time_ns,
) -> dict[str, list[float]]:
    """Return CPU microseconds per unit of work, one list entry a round, after a warm-up round.

    The candidates take turns, so that a slow phase of the machine affects all of them. Each is a
    call that does some units of work and returns their number. The clock returns nanoseconds of
    the calling thread, of the process or of wall time.
    """
    times: dict[str, list[float]] = {name: [] for name in work}
    for turn in range(rounds + 1):
        for name, call in work.items():
            start = clock()
            units = call()
            if turn:
                times[name].append((clock() - start) / 1000 / units)
    return times


def middle(times: Sequence[float], digits: int | None = None) -> float:
    """Return the median of times, rounded."""
    return round(statistics.median(times), digits)


def ratio(slow: Sequence[float], fast: Sequence[float]) -> float:
    """Return the median of the ratios within each round."""
    return statistics.median(s / f for s, f in zip(slow, fast, strict=True))


def platform_facts() -> dict[str, Any]:
    """Return what the numbers depend on: CPU, versions, and the instructions that kernels use."""
    cpu = platform.processor()
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        cpu = next((x.split(":", 1)[1].strip() for x in lines if x.startswith("model name")), cpu)
    return {
        "cpu": cpu,
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "kernels for": "AVX2" if kernels.WIDE else f"any {platform.machine()}",
    }


def commit() -> str:
    """Return the commit of the code that is measured, `-dirty` if it has changes since."""

    def git(*words: str) -> str:
        command = ["git", "-C", str(RESULTS.parents[1]), *words]
        return subprocess.run(command, capture_output=True, text=True).stdout.strip()

    changed = git("status", "--porcelain", "--", "cdmisfa", "recorder", "replay")
    return git("rev-parse", "--short=8", "HEAD") + ("-dirty" if changed else "")


def save(
    name: str,
    title: str,
    note: str,
    tables: Sequence[tuple[Sequence[str], Sequence[Sequence[Any]]]],
) -> None:
    """Write results/NAME.json, and print its tables.

    Args:
        name: of the benchmark.
        title: of the results.
        note: what was measured.
        tables: each its header and its rows.
    """
    document = {
        "benchmark": name,
        "title": title,
        "note": note,
        "code": commit(),
        "platform": platform_facts(),
        "tables": [{"header": list(header), "rows": list(rows)} for header, rows in tables],
    }
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{name}.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    print("\n\n".join([f"## {title}", note, *(markdown(*table) for table in tables)]))


@dataclasses.dataclass(frozen=True)
class Part:
    """One part of the page: heading, text, and columns of a stored table from a first row on."""

    heading: str
    text: str
    columns: Sequence[int]
    table: int = 0
    first: int = 0


PARTS = {
    "learn": Part(
        "Learning, and the cost of a log",
        "CPU time of an iteration (40 frames of 48x128, all threads) with the preset `icub`, and "
        "by how much it grows with the log of the run and with the Rerun view, which is written "
        "after the run.",
        (1, 2, 3),
        first=3,
    ),
    "modules": Part(
        "Learning with many modules",
        "CPU time of an iteration of a learner that has already saved modules (32 components, "
        "5 outputs): it computes the outputs of all of them for each block.",
        (0, 1, 2),
    ),
    "live_streams": Part(
        "Live cameras",
        "JPEG streams of 640x480 at 30 Hz over HTTP, recorded and learned from at the same time: "
        "busy cores, and frames lost over all streams.",
        (0, 1, 2, 5, 9),
    ),
    "applying": Part(
        "Computing features of a log",
        "CPU time of a frame: reading alone, with ten modules of one or eight outputs each, and "
        "with a Parquet file as output. Decoding dominates for videos.",
        (0, 1, 2, 3, 4),
    ),
    "estimators": Part(
        "Estimators against other libraries",
        "Five features of an array of sines and noise, one thread. The last column is the slowness "
        "of the slowest output on further samples: smaller is better. RecursiveSFA and IncSFA "
        "first reduce the values to 20 principal components, which is fast; with 300 values their "
        "features change twice as fast as the slowest ones. `RecursiveSFA, all` keeps all values. "
        "IncrementalPCA does not look for slow features.",
        (0, 1, 2, 3, 4, 5),
    ),
    "features": Part(
        "What can be read from features",
        "R2 of the true state by ridge regression from features of one frame, fitted with all, 200 "
        "or 50 labels and judged on following frames: means of 16 streams that no decision used, "
        "with 95 % intervals over streams. `module minus`: paired differences. PC: principal "
        "components; they and batch SFA use all frames to learn from, while a module stops when "
        "its stream is decided. With all labels 64 components are best, with fewer batch SFA.",
        (0, 1, 2, 3, 4, 5, 6, 7),
    ),
    "dots": Part(
        "A moving dot in noise",
        "Error of the position of a dot, in image widths, read from features of one image by ridge "
        "regression: 170 images a trajectory, 5,000 labels. Noise changes with each image, or "
        "turns slowly or is fixed within a trajectory, as in Sobal et al. 2022 (arXiv:2211.10831) "
        "and Gulati and Nemenman 2026 (arXiv:2606.07770). Their curves are plots without values, "
        "so they are not in the table; the first paper reports that JEPA fails if the noise is "
        "fixed. `within`: learned without the mean of the trajectory, applied to images as they "
        "are. Rejected: the learner saves no module.",
        (0, 1, 2, 3, 5, 7, 8, 9, 10, 11),
        table=2,
    ),
    "policies": Part(
        "Behaviour cloning from images",
        "A small network imitates a demonstrator from the last two images: pixels, principal "
        "components, batch SFA, or the outputs of a module. All are learned from the images of 200 "
        "episodes; 10, 50 or 200 of them have actions. 0: random actions, 1: the demonstrator.",
        (0, 1, 2, 3, 4, 5, 6),
    ),
    "messages": Part(
        "Reading messages",
        "Topic, time and payload of every message of an MCAP log, which stores them in the order "
        "of log time; and how many times as fast cdmisfa is as other readers. All check the CRC of "
        "each chunk, except in the last column.",
        (0, 1, 2, 3, 4, 5),
    ),
    "foreign": Part(
        "Reading MCAP logs of other programs",
        "Gray images: CPU time of mcap's own Python reader with the same image decoder, and how "
        "many times as fast cdmisfa is. Both check the CRC of every chunk.",
        (0, 1, 2),
        table=2,
    ),
    "converting": Part(
        "Converting a log",
        "400 images of 640x480 to frames of 80x60. Share: the speed that is left of decoding and "
        "scaling alone when a recording with checksums is written.",
        (0, 1, 2, 3),
    ),
    "corpus": Part(
        "Indexing many logs",
        "Recordings of three views with 1,000 frames each, two processes.",
        (0, 1, 3, 4),
    ),
    "episodes": Part(
        "Bad episodes of a robot dataset",
        "Simulated episodes with planted faults, two cameras, AV1-coded; AUROC is the probability "
        "that a faulty episode has a higher score than a good one of its dataset. No limit of "
        "`cdmisfa episodes` was set on this arm, its tasks, its wrist camera or this seed.",
        (0, 1, 2, 3),
        table=1,
    ),
    "episode_peers": Part(
        "Bad episodes: other tools",
        "AUROC on two datasets with one episode of each fault, by the own score of each tool.",
        (0, 1, 2, 3, 4, 5),
    ),
    "long_recordings": Part(
        "Memory for long recordings",
        "Peak memory of a process, Python and its libraries included, for a short and a long "
        "recording, and the part of the long one that is read.",
        (0, 2, 5, 6),
    ),
    "opening": Part(
        "Opening a long log",
        "Seconds until the first frame of an uncompressed log of another program, with the file "
        "on disk (cold) and in memory (warm), and the part of the file that is read.",
        (0, 1, 2, 3),
    ),
    "startup": Part(
        "Start-up",
        "CPU time of a whole command; `learn` runs one iteration.",
        (0, 1, 2),
    ),
}
"""Parts of the page in their order, by the name of their benchmark."""

INTRODUCTION = """\
# Benchmarks

How fast the commands are, how much memory they need, and how that compares with other libraries.
Repeat a part with `python -m benchmarks NAME` in a checkout with the extra `bench`; `--quick` uses
fewer rounds.

Times depend on the machine; trust the ratios. The candidates of a table take turns within one
process, and a ratio is the median over the rounds, so it may differ from the ratio of two cells.
Times are CPU time unless "wall" is written. The machine also did other work: times
and dropped frames are upper bounds.
"""


def write_page() -> Path:
    """Write docs/evidence/benchmarks.md from the stored results."""
    parts = [INTRODUCTION.strip()]
    for name, part in PARTS.items():
        path = RESULTS / f"{name}.json"
        if not path.exists():
            continue
        document = json.loads(path.read_text(encoding="utf-8"))
        table = document["tables"][part.table]
        rows = [[row[k] for k in part.columns] for row in table["rows"][part.first :]]
        link = f"[{path.name}]({os.path.relpath(path, PAGE.parent)})"
        end = f"`python -m benchmarks {name}` at commit {document['code']}; all tables: {link}."
        columns = [table["header"][k] for k in part.columns]
        parts += [f"## {part.heading}", part.text, markdown(columns, rows), end]
    PAGE.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    return PAGE
