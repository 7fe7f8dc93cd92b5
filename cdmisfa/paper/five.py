"""The paper's example of five streams: the third is the easiest, the first the next."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cdmisfa.experiments.trial import run_trial
from cdmisfa.paper.oscillatory import MAX_ITERATIONS, learner_config
from cdmisfa.paper.reproduce import Claim, Findings, Line, Output, Request, Settings, Trial, learned

TITLE = "Five streams"

SHOWN = ("x2", "x3", "x1", "x3", "x3")
"""What the five show: the easiest is the third, the next the first, the others are as hard."""

OPTIMAL = ((2, "11011"), (0, "01111"))
"""Stream and policy of the first two modules, as the paper's example gives them."""


def plan(request: Request) -> list[dict[str, Any]]:
    """20 trials that differ in their seed."""
    return [{"seed": seed} for seed in range(request.count(20, 4))]


def run(settings: Settings) -> Output:
    """One trial until two modules are learned."""
    result = run_trial(
        learner_config(),
        SHOWN,
        seed=settings["seed"],
        max_iterations=MAX_ITERATIONS,
        max_modules=len(OPTIMAL),
    )
    return learned(result.modules), {}


def evaluate(trials: Sequence[Trial]) -> Findings:
    """Every trial must learn the third stream, then the first, with the example's policies."""
    found = [tuple(zip(t.row["streams"], t.row["policies"], strict=True)) for t in trials]
    good, n = sum(f == OPTIMAL for f in found), len(trials)
    lines = [Line.share("trials with both policies as in the example", "all (text)", good, n)]
    for i, (stream, _) in enumerate(OPTIMAL):
        quantity = f"module {i + 1} (stream {stream + 1}) saved at iteration"
        lines.append(Line.of_module(quantity, trials, "saved_at", i, digits=0))
    claim = Claim.of_all("policies [1,1,0,1,1], then [0,1,1,1,1]", good, n)
    shown = ", ".join(SHOWN)
    return Findings(lines, [claim], [f"The paper names no streams; these show {shown}."])


def draw(trials: Sequence[Trial], folder: Path) -> list[Path]:
    """No figure: the paper has none of it."""
    return []
