"""Compare learners on sets of streams: `python -m benchmarks.arena SET`.

DIR/results.json has a row for each learner, set and seed. Results: docs/evidence/learners.md.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from benchmarks.arena.judging import judge, run_learner
from benchmarks.arena.rules import RULES, Attentive
from benchmarks.arena.streams import GROUPS, SETS, ArenaSource
from cdmisfa.agents.learners import open_learner
from cdmisfa.experiments.documents import plain, versions, write_json
from cdmisfa.experiments.results import mean_interval, summary
from cdmisfa.experiments.sources import Layers, configure

LEARNERS = {
    "progress": "progress learner.attention=novel",
    "2.0": "2.0",
    "1.0": "1.0",
    "learning-progress": "progress learner.attention=progress",
    "random": "progress learner.attention=random",
    **dict.fromkeys(RULES, "progress"),
}
"""Settings of each learner; of `RULES` it is the progress learner with another attention rule."""

MEASURES = {
    "learned": 2, "noise learned": 1, "twice": 1, "noise told": 0, "in vain": 2, "ends": 2,
    "blocks": 0, "all learned": 0, "R2": 2, "R2 of components": 2,
}  # fmt: skip
"""Measures of the table, and their digits."""


def run_trials(name: str, learners: list[str], seed: int, settings: list[str]) -> list[Any]:
    """Run learners on the same streams, and return a row for each."""
    source, rows = ArenaSource(SETS[name]["words"], seed), []
    images = source.spec.images
    for learner in learners:
        words = [*f"learner.algorithm={LEARNERS[learner]}".split(), *settings]
        config = configure("icub" if images else "oscillatory", Layers.read(words=words)).learner
        source.t = 0
        if learner in RULES:
            course = run_learner(Attentive(config, source.spec, seed, learner), source, name)
        else:
            course = run_learner(open_learner(config, source.spec, seed), source, name)
        expansion = config.expansion or ("none" if images else "quadratic")
        scores = judge(course, source, config.components, expansion)
        rows.append({"set": name, "learner": learner, "seed": seed, **scores})
    return rows


def table(rows: list[Any]) -> str:
    """Return means over seeds, with 95 % intervals (Student) where they differ."""
    head = ["set", "learner", "seeds", *MEASURES]
    lines, key = [head], lambda row: (row["set"], row["learner"])
    for (name, learner), group in itertools.groupby(rows, key):
        of = list(group)
        line = [name, learner, str(len(of))]
        for measure, digits in MEASURES.items():
            values = [row[measure] for row in of if row[measure] is not None]
            mean, (low, high) = summary(values), mean_interval(values)
            spread = f" [{low:.{digits}f}, {high:.{digits}f}]" if mean.n > 1 and mean.sd else ""
            line.append(f"{mean.mean:.{digits}f}{spread}" if values else "-")
        lines.append(line)
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join("  ".join(map(str.ljust, line, widths)).rstrip() for line in lines)


def main(arguments: list[str] | None = None) -> None:
    """Run every learner on every set with every seed, and print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.arena", description=__doc__)
    parser.add_argument("sets", nargs="+", choices=[*GROUPS, *SETS], metavar="SET")
    parser.add_argument("--learners", default=",".join(LEARNERS), help="NAME,NAME")
    parser.add_argument("--seeds", default="0:10", help="FIRST:END")
    parser.add_argument("--set", action="append", default=[], metavar="learner.KEY=VALUE")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument(
        "-o", "--output", dest="out", type=Path, default=Path("arena"), help="folder"
    )
    given = parser.parse_args(arguments)
    learners = given.learners.split(",")
    sets = dict.fromkeys(name for word in given.sets for name in GROUPS.get(word, [word]))
    seeds, rows = range(*map(int, given.seeds.split(":"))), []
    given.out.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(given.jobs, get_context("spawn")) as pool:
        tasks = itertools.product(sets, [learners], seeds, [given.set])
        for done in pool.map(run_trials, *zip(*tasks, strict=True)):
            rows += done
            document = {"schema": 2, "rows": rows, "versions": versions()}
            write_json(given.out / "results.json", plain(document))
            print(done[0]["set"], "seed", done[0]["seed"], file=sys.stderr)
    rows.sort(key=lambda row: (list(SETS).index(row["set"]), learners.index(row["learner"])))
    print(table(rows))
