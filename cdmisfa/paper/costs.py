"""CD-MISFA 1.0 against 2.0: what an iteration costs, and how many numbers are to be chosen."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cdmisfa import kernels
from cdmisfa.agents.agent import OUTCOME, Frozen, as_struct, new_agent, rules
from cdmisfa.core.config import LearnerConfig
from cdmisfa.experiments.trial import run_trial
from cdmisfa.paper.oscillatory import STREAMS, learner_config
from cdmisfa.paper.reproduce import Claim, Findings, Line, Output, Request, Settings, Trial, groups
from cdmisfa.paper.stability import ITERATIONS, NEVER

TITLE = "What CD-MISFA 2.0 costs, against 1.0"

WORLDS = ((3, 0), (3, 3), (60, 0))
"""Streams, and frozen modules that the gate asks: as in the paper, later on, and many streams."""

BLOCKS = 20_000
"""Blocks over which the work that the two do not share is timed."""

PHASES = 5
"""Blocks of 100 frames that differ, of a signal with a period of 500."""

PAPERS = ("nu", "delta", "beta", "epsilon_decay", "tau", "sigma")
"""The hyper-parameters that the paper lists for 2.0."""

OWN = {
    "1.0": ("alpha", "roc_centres", "roc_radius", "roc_memory", "roc_error"),
    "2.0": ("delta", "gate_window"),
}
"""Keys of the configuration that only one of the two uses."""


def plan(request: Request) -> list[dict[str, Any]]:
    """Ten rounds of each world; in a round both are timed in turn, in one process."""
    n = request.count(10, 2)
    return [{"streams": s, "modules": m, "seed": seed} for s, m in WORLDS for seed in range(n)]


def run(settings: Settings) -> Output:
    """CPU time of an iteration of 2.0, and of the work that only 2.0 and only 1.0 does in it.

    Whole iterations are timed where nothing is frozen. 1.0 is told by its parts: its iterations
    here keep 2.0's statistics for the record, too, which is no cost of 1.0.
    """
    streams, modules, seed = settings["streams"], settings["modules"], settings["seed"]
    work = {name: _work(name, streams, modules) for name in ("2.0", "1.0")}
    own = {name: work[name](BLOCKS) for name in sorted(work, reverse=bool(seed % 2))}
    row = {f"own_{name}": own[name] for name in work}
    if not modules:
        row["whole_2.0"] = _whole(streams, seed)
        row["whole_1.0"] = row["whole_2.0"] - own["2.0"] + own["1.0"]
    return row, {}


def _whole(streams: int, seed: int) -> float:
    """CPU time of an iteration of 2.0, in microseconds."""
    config, names = learner_config(**NEVER), STREAMS * (streams // len(STREAMS))

    def iterate(iterations: int) -> int:
        result = run_trial(config, names, seed=seed, max_iterations=iterations, max_modules=1)
        return result.iterations

    return _timed(iterate, ITERATIONS)


def _timed(work: Callable[[int], Any], count: int) -> float:
    """CPU time of one of `count` repetitions, in microseconds."""
    start = time.process_time_ns()
    work(count)
    return (time.process_time_ns() - start) / count / 1000


def _work(algorithm: str, streams: int, modules: int) -> Callable[[int], float]:
    """What tells the time of a block of the work that only one of the algorithms does."""
    config = learner_config(algorithm=algorithm)
    theta = 2 * np.pi * np.arange(PHASES * config.tau) / (PHASES * config.tau)
    y = np.sqrt(2.0) * np.sin(4 * theta).reshape(PHASES, config.tau, 1)
    y_frozen = np.repeat(y[:, None], modules, axis=1)
    agent, told = new_agent(config, streams, 0), np.empty((modules, 1))
    known = as_struct(agent, rules(config, streams), np.zeros(1, OUTCOME))
    outputs = [kernels.pointer("y", array, array.shape) for array in (y, y_frozen, told)]

    def repeat(blocks: int, count: int = modules) -> None:
        clusters = [np.repeat(a[None], count, axis=0) for a in (agent.centres, agent.counts)]
        none = np.zeros((count, 1))
        frozen = Frozen(none, np.zeros(count), none, none, *clusters).struct
        kernels.lib.own_work(known.pointer, frozen.pointer, blocks, PHASES, *outputs)

    repeat(PHASES, 0)  # finds the clusters
    return lambda blocks: _timed(repeat, blocks)


def parameters(algorithm: str) -> list[str]:
    """The keys of the configuration that an algorithm uses."""
    other = OWN["2.0" if algorithm == "1.0" else "1.0"]
    keys = [field.name for field in dataclasses.fields(LearnerConfig)]
    return [key for key in keys if key != "algorithm" and key not in other]


def evaluate(trials: Sequence[Trial]) -> Findings:
    """2.0 must take less time in every world, and have fewer numbers to choose."""
    lines: list[Line] = []
    cheaper: list[bool] = []
    details = []
    for (streams, modules), group in groups(trials, "streams", "modules").items():
        at = f"{streams} streams, {modules} frozen modules"
        rows = [t.row for t in group]
        ratios = [r["own_1.0"] / r["own_2.0"] for r in rows]
        for name in ("1.0", "2.0"):
            own = [r[f"own_{name}"] for r in rows]
            lines.append(Line.measured(f"us a block that only {name} needs, {at}", own, digits=2))
        more = "more (text)"
        lines.append(Line.measured(f"1.0 over 2.0 in these, {at}", ratios, more, digits=2))
        whole = [r for r in rows if r.get("whole_2.0") is not None]
        if whole:
            for name in ("1.0", "2.0"):
                values = [r[f"whole_{name}"] for r in whole]
                quantity = f"us an iteration of {name}, {at}"
                lines.append(Line.measured(quantity, values, digits=1))
            all_of_it = [r["whole_1.0"] / r["whole_2.0"] for r in whole]
            quantity = f"1.0 over 2.0 in whole iterations, {at}"
            lines.append(Line.measured(quantity, all_of_it, more, digits=3))
        cheaper.append(float(np.median(ratios)) > 1.0)
        details.append(f"{np.median(ratios):.2f}")
    counts = {name: len(parameters(name)) for name in OWN}
    papers = len(PAPERS)
    instead = len(PAPERS) - len(set(PAPERS) & set(OWN["2.0"])) + len(OWN["1.0"])
    lines += [
        Line.measured(
            "hyper-parameters of 2.0, of those the paper lists", papers, "6 (text)", digits=0
        ),
        Line.measured("the same for 1.0", instead, "more (text)", digits=0),
        Line.measured("keys of the configuration that 2.0 uses", counts["2.0"], digits=0),
        Line.measured("keys of the configuration that 1.0 uses", counts["1.0"], digits=0),
    ]
    claims = [
        Claim(
            "2.0 is computationally less expensive",
            all(cheaper),
            f"1.0 takes {', '.join(details)} times as long for what only one of them needs "
            "(medians of the rounds' ratios)",
        ),
        Claim(
            "2.0 has fewer hyper-parameters",
            counts["2.0"] < counts["1.0"] and papers < instead,
            f"{papers} against {instead} in the paper's terms, {counts['2.0']} against "
            f"{counts['1.0']} keys; 1.0 needs labels, too",
        ),
    ]
    return Findings(lines, claims)


def draw(trials: Sequence[Trial], folder: Path) -> list[Path]:
    """No figure: the table says it all."""
    return []
