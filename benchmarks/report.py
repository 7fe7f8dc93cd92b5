"""Interleaved timing, and results as JSON and Markdown."""

from __future__ import annotations

import contextlib
import json
import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cdmisfa import kernels
from cdmisfa.core.errors import CdmisfaError
from cdmisfa.core.names import counted
from cdmisfa.experiments.documents import markdown

RESULTS = Path(__file__).parent / "results"
SAMPLE = Path(__file__).parent.parent / "sample_logs" / "icub"
PAGE = Path(__file__).parent.parent / "docs" / "results" / "benchmarks.md"
PICTURE = "../images/benchmarks.png"
"""The figure of the history, from the page's folder."""


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
    """What the numbers depend on: CPU, versions, and the instructions that the kernels use."""
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
    **data: Any,
) -> None:
    """Write results/NAME.json, with further values in `data`, and print it.

    The title is its heading on the page, the note says what was measured; a table is its header
    and its rows.
    """
    RESULTS.mkdir(exist_ok=True)
    document = {
        "benchmark": name,
        "title": title,
        "note": note,
        "platform": platform_facts(),
        "tables": [{"header": list(header), "rows": list(rows)} for header, rows in tables],
        **data,
    }
    text = json.dumps(document, indent=1) + "\n"
    (RESULTS / f"{name}.json").write_text(text, encoding="utf-8")
    print(section(document))


def section(document: Mapping[str, Any], data: str = "") -> str:
    """One benchmark's results; where its data is linked, with its first table alone."""
    tables = [markdown(t["header"], t["rows"]) for t in document["tables"]]
    facts = ", ".join(f"{key} {value}" for key, value in document["platform"].items())
    of = f" {document['code']}" if "code" in document else ""
    end = f"Measured{of} on: {facts}."
    if data:
        more = f"{counted(len(tables) - 1, 'more table')} and " if tables[1:] else ""
        tables, end = tables[:1], f"Measured{of}; {more}the machine: [{Path(data).name}]({data})."
    return "\n\n".join([f"## {document['title']}", document["note"], *tables, end])


def write_page() -> Path:
    """Write docs/results/benchmarks.md from the results there are.

    Raises:
        CdmisfaError: those of one contradict each other.
    """
    found = (json.loads(p.read_text(encoding="utf-8")) for p in sorted(RESULTS.glob("*.json")))
    documents = [document for document in found if "tables" in document]
    for document in documents:
        for text in document.get("contradictions", ()):
            raise CdmisfaError(
                f"results/{document['benchmark']}.json contradicts itself ({text}): measure it "
                f"again with python -m benchmarks {document['benchmark']}"
            )
    head = (
        "# Benchmarks\n\n`make bench` measures all of it and makes this page from "
        "`benchmarks/results/*.json`; `python -m benchmarks NAME [--quick]` measures one part, "
        "`python -m benchmarks page` makes the page. Candidates take turns, times are CPU time, "
        "and what counts is the median of the ratios within each round: a slow spell of the "
        "machine hits all of them. So the ratio of two cells need not be the ratio beside them. "
        "Below each part stands the commit that it measured: parts of different commits are not "
        "to be compared with each other."
    )
    results = os.path.relpath(RESULTS, PAGE.parent)
    parts = [head, *(section(each, f"{results}/{each['benchmark']}.json") for each in documents)]
    if (PAGE.parent / PICTURE).exists():
        parts.insert(
            1,
            f"![Ratios over the commits]({PICTURE})\n\nRatios of `benchmarks/results/history`, "
            "which holds those of each commit that was measured, in the order of the commits; a "
            "day stands where its first one is.",
        )
    PAGE.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    return PAGE
