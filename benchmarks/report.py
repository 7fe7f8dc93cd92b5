"""Interleaved timing, and results as JSON and Markdown."""

from __future__ import annotations

import contextlib
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
PAGE = Path(__file__).parent.parent / "docs" / "results" / "benchmarks.md"


def interleaved(
    work: Mapping[str, Callable[[], int]],
    rounds: int,
    clock: Callable[[], int] = time.thread_time_ns,
) -> dict[str, list[float]]:
    """CPU microseconds per unit of work, one list entry a round, after one round to warm up.

    The candidates take turns, so that a slow spell of the machine hits all of them. Each is a call
    that does some units of work and returns how many. The clock tells nanoseconds, of the calling
    thread; or of the process or the wall.
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
    """The median of times, rounded."""
    return round(statistics.median(times), digits)


def ratio(slow: Sequence[float], fast: Sequence[float]) -> float:
    """Median of the ratios within each round."""
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


def save(
    name: str,
    title: str,
    note: str,
    tables: Sequence[tuple[Sequence[str], Sequence[Sequence[Any]]]],
) -> None:
    """Write results/NAME.json, and print its tables.

    Args:
        name: of the benchmark.
        title: its heading on the page.
        note: what was measured.
        tables: each its header and its rows.
    """
    git = ["git", "-C", str(RESULTS.parent), "describe", "--always", "--dirty"]
    document = {
        "benchmark": name,
        "title": title,
        "note": note,
        "code": subprocess.run(git, capture_output=True, text=True).stdout.strip(),
        "platform": platform_facts(),
        "tables": [{"header": list(header), "rows": list(rows)} for header, rows in tables],
    }
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{name}.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    print("\n\n".join([f"## {title}", note, *(markdown(*table) for table in tables)]))


def write_page() -> Path:
    """Write docs/results/benchmarks.md from the results: the first table of each."""
    parts = [
        "# Benchmarks\n\n`make bench` measures all of it and makes this page from "
        "`benchmarks/results/*.json`; `python -m benchmarks NAME [--quick]` measures one part, "
        "`python -m benchmarks page` makes the page. Candidates take turns, times are CPU time, "
        "and what counts is the median of the ratios within each round: a slow spell of the "
        "machine hits all of them. So the ratio of two cells need not be the ratio beside them. "
        "Below each part is the commit that it measured: parts of different commits are not "
        "to be compared with each other."
    ]
    for path in sorted(RESULTS.glob("*.json")):
        document = json.loads(path.read_text(encoding="utf-8"))
        first = document["tables"][0]
        link = f"[{path.name}]({os.path.relpath(path, PAGE.parent)})"
        end = f"Measured at {document['code']}; the machine and all tables: {link}."
        table = markdown(first["header"], first["rows"])
        parts += [f"## {document['title']}", document["note"], table, end]
    PAGE.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    return PAGE
