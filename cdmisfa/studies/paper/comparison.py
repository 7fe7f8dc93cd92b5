"""CD-MISFA 1.0 against 2.0: whose policy is stable, and what an iteration costs."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cdmisfa import kernels
from cdmisfa.agents.agent import OUTCOME, Frozen, as_struct, new_agent, rules
from cdmisfa.core.config import LearnerConfig
from cdmisfa.experiments.trial import run_trial
from cdmisfa.studies import pages
from cdmisfa.studies.paper import panels
from cdmisfa.studies.paper.experiment import (
    Experiment,
    Findings,
    Output,
    Request,
    Settings,
    Trial,
    groups,
)
from cdmisfa.studies.paper.oscillatory import STREAMS, paper_config

ALGORITHMS = ("1.0", "2.0")

ITERATIONS = 1200
"""About 200 of exploration and 1000 after epsilon is set to 0."""

NEVER = {"delta": 1e-12, "roc_error": 0.0}
"""Thresholds under which no module is saved, so that the policy alone is on trial."""

BLOCKS = 20_000
"""Blocks over which the work that the two do not share is timed."""

PHASES = 5
"""Blocks of 100 frames that differ, of a signal with a period of 500."""

LISTED = ("nu", "delta", "beta", "epsilon_decay", "tau", "sigma")
"""The hyper-parameters that the paper lists for 2.0."""

OWN_KEYS = {
    "1.0": ("alpha", "roc_centres", "roc_radius", "roc_memory", "roc_error"),
    "2.0": ("delta", "gate_window"),
}
"""Keys of the configuration that only one of the two uses."""


class Stability(Experiment):
    """Whose policy stays once nothing is explored any more?"""

    title = "CD-MISFA 1.0 against 2.0"
    trials = (20, 3)

    def conditions(self, request: Request) -> list[Settings]:
        """Each algorithm."""
        return [{"algorithm": algorithm} for algorithm in ALGORITHMS]

    def run(self, settings: Settings) -> Output:
        """Epsilon falls by .998 an iteration, is 0 from .8 on; the policy's changes then count."""
        keys = {"algorithm": settings["algorithm"], "epsilon_decay": 0.998}
        config = paper_config("oscillatory", **keys, epsilon_tail_decay=0.0, **NEVER)
        result = run_trial(
            config, seed=settings["seed"], max_iterations=ITERATIONS, max_modules=1, curves=True
        )
        curves: Any = result.curves
        still = int(np.argmax(curves["epsilon"] == 0.0))
        policy = curves["policy"]
        row = {
            "exploration_ends": still,
            "changes": int((np.diff(policy[still:], axis=0) != 0).any(axis=1).sum()),
            "before": "".join(map(str, policy[still])),
            "after": "".join(map(str, policy[-1])),
        }
        return row, {"R": curves["R"].astype(np.float32), "policy": policy.astype(np.int8)}

    def evaluate(self, trials: Sequence[Trial], found: Findings) -> None:
        """2.0 must never change its policy, 1.0 at least once in every trial."""
        old, new = (groups(trials, "algorithm")[a,] for a in ALGORITHMS)
        changes = [t.row["changes"] for t in old]
        unstable = sum(c > 0 for c in changes)
        stable = sum(t.row["changes"] == 0 for t in new)
        optimal, n = sum(t.row["after"] == "011" for t in new), len(new)
        changed, seen = "1.0: changes of policy after epsilon = 0", "all (figure)"
        found.share("2.0: trials without a change of policy", seen, stable, n)
        found.share("1.0: trials with a change of policy", seen, unstable, n)
        found.measured(changed, changes, ">= 1 (figure)", digits=1)
        found.share("2.0: trials that end with [0,1,1]", seen, optimal, n)
        found.claim_all("2.0 keeps its policy after epsilon = 0", stable, n)
        found.claim_all("1.0 changes its policy after epsilon = 0", unstable, n)

    def draw(self, trials: Sequence[Trial], folder: Path) -> list[Path]:
        """The paper's four panels: one trial's reward function and policy, 1.0 above 2.0."""
        figure, axes = panels.figure_of_panels(2, 2)
        for row, algorithm in enumerate(ALGORITHMS):
            one = groups(trials, "algorithm")[algorithm,][0]
            panels.rewards(axes[row, 0], [one], "ac"[row], f"{algorithm}: R, stay entries")
            panels.policies(axes[row, 1], [one], "bd"[row], f"{algorithm}: policy")
            ends = {"color": "grey", "linestyle": ":", "linewidth": 0.8}
            for panel in axes[row]:
                panel.axvline(one.row["exploration_ends"], **ends)
        return pages.save_figure(figure, folder, "stability")


class Costs(Experiment):
    """What an iteration costs, and how many numbers are to be chosen."""

    title = "What CD-MISFA 2.0 costs, against 1.0"
    worlds = ((3, 0), (3, 3), (60, 0))
    """Streams, and frozen modules that the gate asks: as in the paper, later on, many streams."""

    trials = (10, 2)
    """Rounds of each world; in a round both algorithms are timed in turn, in one process."""

    def conditions(self, request: Request) -> list[Settings]:
        """Each world."""
        return [{"streams": streams, "modules": modules} for streams, modules in self.worlds]

    def run(self, settings: Settings) -> Output:
        """CPU time of an iteration of 2.0, and of the work that only 2.0 and only 1.0 does in it.

        Whole iterations are timed where nothing is frozen. 1.0 is told by its parts: its
        iterations here keep 2.0's statistics for the record, too, which is no cost of 1.0.
        """
        streams, modules, seed = settings["streams"], settings["modules"], settings["seed"]
        turn = sorted(ALGORITHMS, reverse=bool(seed % 2))
        own = {algorithm: own_microseconds(algorithm, streams, modules) for algorithm in turn}
        row = {"own_2.0": own["2.0"], "own_1.0": own["1.0"]}
        if not modules:
            config, names = paper_config("oscillatory", **NEVER), STREAMS * (streams // 3)
            start = time.process_time_ns()
            run_trial(config, names, seed=seed, max_iterations=ITERATIONS, max_modules=1)
            row["whole_2.0"] = (time.process_time_ns() - start) / ITERATIONS / 1000
            row["whole_1.0"] = row["whole_2.0"] - own["2.0"] + own["1.0"]
        return row, {}

    def evaluate(self, trials: Sequence[Trial], found: Findings) -> None:
        """2.0 must take less time in every world, and have fewer numbers to choose."""
        medians = []
        for (streams, modules), group in groups(trials, "streams", "modules").items():
            at = f"{streams} streams, {modules} frozen modules"
            own = {a: np.array([t.row[f"own_{a}"] for t in group]) for a in ALGORITHMS}
            for name, times in own.items():
                found.measured(f"us a block that only {name} needs, {at}", times, digits=2)
            ratios = own["1.0"] / own["2.0"]
            medians.append(float(np.median(ratios)))
            found.measured(f"1.0 over 2.0 in these, {at}", ratios, "more (text)", digits=2)
            if modules:
                continue
            whole = {a: np.array([t.row[f"whole_{a}"] for t in group]) for a in ALGORITHMS}
            for name, times in whole.items():
                found.measured(f"us an iteration of {name}, {at}", times, digits=1)
            ratios = whole["1.0"] / whole["2.0"]
            quantity = f"1.0 over 2.0 in whole iterations, {at}"
            found.measured(quantity, ratios, "more (text)", digits=3)
        old, new = (len(used_keys(name)) for name in ALGORITHMS)
        listed = len(LISTED)
        instead = len(set(LISTED) - set(OWN_KEYS["2.0"])) + len(OWN_KEYS["1.0"])
        listed_by = "hyper-parameters of 2.0, of those the paper lists"
        found.measured(listed_by, listed, "6 (text)", digits=0)
        found.measured("the same for 1.0", instead, "more (text)", digits=0)
        found.measured("keys of the configuration that 2.0 uses", new, digits=0)
        found.measured("keys of the configuration that 1.0 uses", old, digits=0)
        found.claim(
            "2.0 is computationally less expensive",
            all(median > 1.0 for median in medians),
            f"1.0 takes {', '.join(f'{m:.2f}' for m in medians)} times as long for what only "
            "one of them needs (medians of the rounds' ratios)",
        )
        found.claim(
            "2.0 has fewer hyper-parameters",
            new < old and listed < instead,
            f"{listed} against {instead} in the paper's terms, {new} against {old} keys; 1.0 "
            "needs labels, too",
        )


def own_microseconds(algorithm: str, streams: int, modules: int) -> float:
    """CPU time of a block of the work that only one of the algorithms does."""
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
    """The keys of the configuration that an algorithm uses."""
    other = OWN_KEYS["2.0" if algorithm == "1.0" else "1.0"]
    keys = [field.name for field in dataclasses.fields(LearnerConfig)]
    return [key for key in keys if key != "algorithm" and key not in other]
