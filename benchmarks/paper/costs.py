"""What an iteration of CD-MISFA 2.0 costs, against 1.0, and how many numbers are to be chosen."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.paper import Table, study
from cdmisfa import kernels
from cdmisfa.agents.agent import OUTCOME, Frozen, as_struct, new_agent, rules
from cdmisfa.core.config import LearnerConfig
from cdmisfa.experiments.trial import run_oscillatory_trial
from cdmisfa.studies.paper.experiment import Settings, Trial, groups, mean_text, paper_config
from cdmisfa.studies.paper.oscillatory import ALGORITHMS, ITERATIONS, NEVER, STREAMS

WORLDS = ((3, 0), (3, 3), (60, 0))
"""Streams, and frozen modules that the gate asks: as in the paper, later on, many streams."""

BLOCKS = 20_000
"""Blocks over which the work that the two do not share is timed."""

PHASES = 5
"""Blocks of 100 frames that differ, of a signal with a period of 500."""

OWN_KEYS = {
    "1.0": ("alpha", "roc_centres", "roc_radius", "roc_memory", "roc_error"),
    "2.0": ("delta", "gate_window"),
}
"""Keys of the configuration that only one of the two uses."""


def run(settings: Settings) -> dict[str, Any]:
    """Time an iteration of 2.0, and the work that only 2.0 and only 1.0 does in it.

    Whole iterations are timed where nothing is frozen. 1.0 is timed by its parts: its iterations
    here keep 2.0's statistics for the record, too, which is no cost of 1.0.
    """
    streams, modules, seed = (settings[key] for key in ("streams", "modules", "seed"))
    turn = sorted(ALGORITHMS, reverse=bool(seed % 2))
    row = {algorithm: own_microseconds(algorithm, streams, modules) for algorithm in turn}
    if not modules:
        config, names = paper_config("oscillatory", **NEVER), STREAMS * (streams // 3)
        start = time.process_time_ns()
        run_oscillatory_trial(config, names, seed=seed, max_iterations=ITERATIONS, max_modules=1)
        row["whole"] = (time.process_time_ns() - start) / ITERATIONS / 1000
    return row


def own_microseconds(algorithm: str, streams: int, modules: int) -> float:
    """Return the CPU time of a block of the work that only one of the algorithms does."""
    config = paper_config("oscillatory", algorithm=algorithm)
    theta = 2 * np.pi * np.arange(PHASES * config.tau) / (PHASES * config.tau)
    y = np.sqrt(2.0) * np.sin(4 * theta).reshape(PHASES, config.tau, 1)
    y_frozen = np.repeat(y[:, None], modules, axis=1)
    agent, eta_frozen = new_agent(config, streams, 0), np.empty((modules, 1))
    known = as_struct(agent, rules(config, streams), np.zeros(1, OUTCOME))
    outputs = [kernels.pointer("y", array, array.shape) for array in (y, y_frozen, eta_frozen)]

    def repeat(blocks: int, count: int) -> None:
        clusters = [np.repeat(a[None], count, axis=0) for a in (agent.centres, agent.counts)]
        none = np.zeros((count, 1))
        frozen = Frozen(none, np.zeros(count), none, none, *clusters).struct
        kernels.lib.own_work(known.pointer, frozen.pointer, blocks, PHASES, *outputs)

    repeat(PHASES, 0)  # finds the clusters
    start = time.process_time_ns()
    repeat(BLOCKS, modules)
    return (time.process_time_ns() - start) / BLOCKS / 1000


def used_keys(algorithm: str) -> list[str]:
    """Return the keys of the configuration that an algorithm uses."""
    other = OWN_KEYS["2.0" if algorithm == "1.0" else "1.0"]
    keys = [field.name for field in dataclasses.fields(LearnerConfig)]
    return [key for key in keys if key != "algorithm" and key not in other]


def tables(trials: Sequence[Trial]) -> list[Table]:
    """Tabulate CPU times of a block, and the keys of each algorithm."""
    rows = []
    for (streams, modules), group in groups(trials, "streams", "modules").items():
        old, new = (np.array([t.row[a] for t in group]) for a in ALGORITHMS)
        row = [
            f"{streams}, {modules}",
            mean_text(old, 2),
            mean_text(new, 2),
            mean_text(old / new, 2),
        ]
        whole = np.array([t.row["whole"] for t in group if not modules])
        ratio = (
            [mean_text(whole, 1), mean_text((whole - new + old) / whole, 3)] if len(whole) else []
        )
        rows.append([*row, *(ratio or ("-", "-"))])
    head = ("streams, frozen modules", "only 1.0, us", "only 2.0, us", "1.0 over 2.0 in these")
    keys = [[name, len(used_keys(name))] for name in ALGORITHMS]
    return [
        ((*head, "iteration of 2.0, us", "1.0 over 2.0 in iterations"), rows),
        (("algorithm", "keys"), keys),
    ]


if __name__ == "__main__":
    study("costs", [{"streams": s, "modules": m} for s, m in WORLDS], run, tables)
