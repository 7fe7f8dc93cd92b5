"""How much of what is new in recordings `cdmisfa curate` finds: events that were planted.

`python -m benchmarks curation` measures, `python -m benchmarks page` makes the page.
"""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet as pq

from benchmarks.corpus import cost_of, write_corpus
from benchmarks.curation.choosing import trial
from benchmarks.curation.worlds import WORLDS
from benchmarks.report import RESULTS, platform_facts
from cdmisfa.core.processes import WorkerDied, run_all
from replay.corpus.finding import INDEX

SEEDS: Final = {"tuned": range(3), "reported": range(100, 105)}
"""Of each group of worlds."""

MANY: Final = (500, 2000)
"""Recordings whose curation is watched for its memory."""


def memory(recordings: int) -> list[object]:
    """What `curate` takes on that many recordings: blocks, CPU in seconds, peak in MB."""
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        write_corpus(folder, recordings)
        cost_of("index", folder)
        with pq.ParquetFile(folder / INDEX) as file:
            table = file.read()
        apart = pa.array([f"{i:064x}" for i in range(len(table))])  # links would be doubles
        place = table.schema.get_field_index("identity")
        pq.write_table(table.set_column(place, table.schema.field(place), apart), folder / INDEX)
        out = folder / "out"
        _, busy, peak = cost_of("curate", folder, "--budget", "10min", "--jobs", 1, "-o", out)
        return [recordings, pq.read_metadata(out / "blocks.parquet").num_rows, busy, round(peak)]


def main(*, quick: bool = False, full: bool = False) -> None:
    """Measure, and write results/curation.json."""
    tasks = [
        (group, world, seed)
        for group, worlds in WORLDS.items()
        for world in worlds
        for seed in SEEDS[group][: 1 if quick else None]
    ]
    trials: dict[int, Any] = {}
    for number, found in run_all(trial, tasks, jobs=min(os.cpu_count() or 1, 2)):
        if isinstance(found, WorkerDied):
            raise SystemExit(f"{tasks[number]}: {found.what}")
        trials[number] = found
        print(*tasks[number], found["means"]["curate"]["found"])
    document = {
        "benchmark": "curation",
        "platform": platform_facts(),
        "trials": [trials[number] for number in sorted(trials)],
        "memory": [memory(recordings) for recordings in MANY[: 1 if quick else None]],
    }
    (RESULTS / "curation.json").write_text(json.dumps(document, indent=1) + "\n", "utf-8")
