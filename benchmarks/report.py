"""Interleaved timing, and results as JSON and Markdown."""

from __future__ import annotations

import json
import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numba
import numpy as np

RESULTS = Path(__file__).parent / "results"


def interleaved(work: Mapping[str, Callable[[], int]], rounds: int) -> dict[str, list[float]]:
    """CPU microseconds of the calling thread per unit of work, one list entry a round.

    The candidates take turns, so that a slow spell of the machine hits all of them.

    Args:
        work: name -> a call that does some units of work and returns how many.
        rounds: how often each has its turn, after one turn to warm up.
    """
    times: dict[str, list[float]] = {name: [] for name in work}
    for turn in range(rounds + 1):
        for name, call in work.items():
            start = time.thread_time_ns()
            units = call()
            if turn:
                times[name].append((time.thread_time_ns() - start) / 1000 / units)
    return times


def ratio(slow: Sequence[float], fast: Sequence[float]) -> float:
    """Median of the ratios within each round."""
    return statistics.median(s / f for s, f in zip(slow, fast, strict=True))


def platform_facts() -> dict[str, Any]:
    """What the numbers depend on: CPU and versions."""
    cpu = platform.processor()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        cpu = next((x.split(":", 1)[1].strip() for x in lines if x.startswith("model name")), cpu)
    except OSError:
        pass
    return {
        "cpu": cpu,
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "numba": numba.__version__,
    }


def table(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


def save(name: str, results: Mapping[str, Any], markdown: str) -> None:
    """Write results/NAME.json and results/NAME.md, and print the latter."""
    RESULTS.mkdir(exist_ok=True)
    document = {"benchmark": name, "platform": platform_facts(), **results}
    text = json.dumps(document, indent=1) + "\n"
    (RESULTS / f"{name}.json").write_text(text, encoding="utf-8")
    (RESULTS / f"{name}.md").write_text(markdown + "\n", encoding="utf-8")
    print(markdown)
