"""CD-MISFA 1.0 against 2.0: whose policy stays once nothing is explored any more?"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cdmisfa.experiments.trial import run_trial
from cdmisfa.paper import panels
from cdmisfa.paper.oscillatory import learner_config
from cdmisfa.paper.reproduce import Claim, Findings, Line, Output, Request, Settings, Trial, groups

TITLE = "CD-MISFA 1.0 against 2.0"

ALGORITHMS = ("1.0", "2.0")

ITERATIONS = 1200
"""About 200 of exploration and 1000 after epsilon is set to 0."""

NEVER = {"delta": 1e-12, "roc_error": 0.0}
"""Thresholds under which no module is saved, so that the policy alone is on trial."""


def plan(request: Request) -> list[dict[str, Any]]:
    """20 trials of each algorithm, with the same seeds."""
    n = request.count(20, 3)
    return [{"algorithm": a, "seed": seed} for a in ALGORITHMS for seed in range(n)]


def run(settings: Settings) -> Output:
    """Epsilon falls by .998 an iteration and is 0 from .8 on; count the policy's changes then."""
    config = learner_config(
        algorithm=settings["algorithm"], epsilon_decay=0.998, epsilon_tail_decay=0.0, **NEVER
    )
    result = run_trial(
        config, seed=settings["seed"], max_iterations=ITERATIONS, max_modules=1, curves=True
    )
    curves: Any = result.curves
    still = int(np.argmax(curves["epsilon"] == 0.0))
    policy = curves["policy"]
    changed = (np.diff(policy[still:], axis=0) != 0).any(axis=1)
    row = {
        "exploration_ends": still,
        "changes": int(changed.sum()),
        "before": "".join(map(str, policy[still])),
        "after": "".join(map(str, policy[-1])),
    }
    return row, {"R": curves["R"].astype(np.float32), "policy": policy.astype(np.int8)}


def evaluate(trials: Sequence[Trial]) -> Findings:
    """2.0 must never change its policy, 1.0 at least once in every trial."""
    old, new = (groups(trials, "algorithm")[a,] for a in ALGORITHMS)
    changes = [t.row["changes"] for t in old]
    unstable = sum(c > 0 for c in changes)
    stable = sum(t.row["changes"] == 0 for t in new)
    optimal, n = sum(t.row["after"] == "011" for t in new), len(new)
    lines = [
        Line.share("2.0: trials without a change of policy", "all (figure)", stable, n),
        Line.share("1.0: trials with a change of policy", "all (figure)", unstable, n),
        Line.measured(
            "1.0: changes of policy after epsilon = 0", changes, ">= 1 (figure)", digits=1
        ),
        Line.share("2.0: trials that end with [0,1,1]", "all (figure)", optimal, n),
    ]
    claims = [
        Claim.of_all("2.0 keeps its policy after epsilon = 0", stable, n),
        Claim.of_all("1.0 changes its policy after epsilon = 0", unstable, n),
    ]
    return Findings(lines, claims)


def draw(trials: Sequence[Trial], folder: Path) -> list[Path]:
    """The paper's four panels: one trial's reward function and policy, 1.0 above 2.0."""
    drawn, axes = panels.figure(2, 2)
    for row, algorithm in enumerate(ALGORITHMS):
        one = groups(trials, "algorithm")[algorithm,][0]
        panels.rewards(axes[row, 0], [one], "ac"[row], f"{algorithm}: R, stay entries")
        panels.policies(axes[row, 1], [one], "bd"[row], f"{algorithm}: policy")
        for panel in axes[row]:
            panel.axvline(one.row["exploration_ends"], color="grey", linestyle=":", linewidth=0.8)
    return panels.save(drawn, folder, "stability")
