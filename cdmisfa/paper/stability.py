"""CD-MISFA 1.0 against 2.0: whose policy stays once nothing is explored any more?"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.experiments.statistics import summary
from cdmisfa.paper import panels
from cdmisfa.paper.oscillatory import learner_config
from cdmisfa.paper.reproduce import Arrays, Claim, Findings, Line, Request, Settings, Trial, share

TITLE = "CD-MISFA 1.0 against 2.0"

ITERATIONS = 1200
"""About 200 of exploration and 1000 after epsilon is set to 0."""

NEVER = {"delta": 1e-12, "roc_error": 0.0}
"""Thresholds under which no module is saved, so that the policy alone is on trial."""


def plan(request: Request) -> list[dict[str, Any]]:
    """20 trials of each algorithm, with the same seeds."""
    n = request.count(20, 3)
    return [{"algorithm": a, "seed": seed} for a in ("1.0", "2.0") for seed in range(n)]


def run(settings: Settings) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Epsilon falls by .998 an iteration and is 0 from .8 on; count the policy's changes then."""
    from cdmisfa.experiments.trial import run_trial

    config = learner_config(
        algorithm=settings["algorithm"], epsilon_decay=0.998, epsilon_tail_decay=0.0, **NEVER
    )
    result = run_trial(
        config, seed=settings["seed"], max_iterations=ITERATIONS, max_modules=1, curves=True
    )
    curves: Arrays = result.curves or {}
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
    changes = {
        a: [t.row["changes"] for t in trials if t.settings["algorithm"] == a]
        for a in ("1.0", "2.0")
    }
    stable = sum(c == 0 for c in changes["2.0"])
    unstable = sum(c > 0 for c in changes["1.0"])
    n = len(changes["2.0"])
    first = [t for t in trials if t.settings["algorithm"] == "2.0"]
    optimal = sum(t.row["after"] == "011" for t in first)
    lines = [
        share("2.0: trials without a change of policy", "all", stable, n),
        share("1.0: trials with a change of policy", "all", unstable, n),
        Line("1.0: changes of policy after epsilon = 0", ">= 1", summary(changes["1.0"]), digits=1),
        share("2.0: trials that end with [0,1,1]", "all", optimal, n),
    ]
    claims = [
        Claim("2.0 keeps its policy after epsilon = 0", stable == n, f"{stable} of {n} trials"),
        Claim(
            "1.0 changes its policy after epsilon = 0", unstable == n, f"{unstable} of {n} trials"
        ),
    ]
    return Findings(lines, claims)


def draw(trials: Sequence[Trial], folder: Path) -> list[Path]:
    """The paper's four panels: one trial's reward function and policy, 1.0 above 2.0."""
    drawn, axes = panels.figure(2, 2)
    for row, algorithm in enumerate(("1.0", "2.0")):
        one = next(t for t in trials if t.settings["algorithm"] == algorithm)
        panels.per_stream(
            axes[row, 0], [one.arrays["R"]], "ac"[row], f"{algorithm}: R, stay entries", each=True
        )
        panels.policies(axes[row, 1], [one.arrays["policy"]], "bd"[row], f"{algorithm}: policy")
        for panel in axes[row]:
            panel.axvline(one.row["exploration_ends"], color="grey", linestyle=":", linewidth=0.8)
    return panels.save(drawn, folder, "stability")
