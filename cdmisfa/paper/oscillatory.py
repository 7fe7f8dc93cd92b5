"""The oscillatory streams: three modules in the order of difficulty, with their policies."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.config import LearnerConfig, build, load_preset
from cdmisfa.core.expansion import quadratic
from cdmisfa.core.modules import Module
from cdmisfa.experiments.trial import run_trial
from cdmisfa.kernels import instantaneous_slowness
from cdmisfa.paper import panels
from cdmisfa.paper.reproduce import Claim, Findings, Line, Output, Request, Settings, Trial, learned
from recorder.world.oscillatory import one_period

TITLE = "Oscillatory streams"

OPTIMAL = ((0, (0, 1, 1)), (1, (1, 0, 1)), (2, (1, 1, 0)))
"""Stream and policy of each module, as the paper gives them."""

STREAMS = ("x1", "x2", "x3")

MAX_ITERATIONS = 10_000


def learner_config(**keys: Any) -> LearnerConfig:
    """The preset of the oscillatory streams with some keys set."""
    return build(LearnerConfig, "learner", load_preset("oscillatory")["learner"], keys)


def plan(request: Request) -> list[dict[str, Any]]:
    """20 trials that differ in their seed."""
    return [{"seed": seed} for seed in range(request.count(20, 4))]


def run(settings: Settings) -> Output:
    """One trial until three modules are learned."""
    result = run_trial(
        learner_config(), seed=settings["seed"], max_iterations=MAX_ITERATIONS, curves=True
    )
    curves: Any = result.curves
    found = tuple((m.stream_index, tuple(m.policy.tolist())) for m in result.modules)
    row = {
        "optimal": found == OPTIMAL,
        "iterations": result.iterations,
        **learned(result.modules),
        "eta": [slowness_on(m) for m in result.modules],
    }
    arrays = {name: curves[name].astype(np.float32) for name in ("eta_dot", "R", "Q")}
    return row, {**arrays, "policy": curves["policy"].astype(np.int8)}


def expanded_period(stream: int) -> NDArray[np.float64]:
    """One period of a stream as the learner sees it, (500, 5)."""
    return quadratic(one_period(STREAMS[stream]))


def slowness_on(module: Module) -> float:
    """Slowness of a module's output on one period of its own stream, in cycles per frame."""
    x = expanded_period(module.stream_index)
    return float(instantaneous_slowness((x - module.mean) @ module.phi[:1].T)[0])


def evaluate(trials: Sequence[Trial]) -> Findings:
    """Every trial must learn x1, x2, x3 in this order with the optimal policies."""
    good, n = sum(bool(t.row["optimal"]) for t in trials), len(trials)
    iterations = [t.row["iterations"] for t in trials]
    lines = [
        Line.share("trials with order and policies optimal", "20 of 20 (text)", good, n),
        Line.measured("iterations until the third module", iterations, digits=0),
    ]
    for i, frequency in enumerate((4, 3, 2)):
        module, paper = f"module {i + 1}", f"{frequency / 500:.4f} (equation)"
        slowness = f"slowness of {module} on its stream (paper: its frequency)"
        lines += [
            Line.of_module(f"{module} saved at iteration", trials, "saved_at", i, digits=0),
            Line.of_module(slowness, trials, "eta", i, paper, digits=4),
        ]
    claim = Claim.of_all(
        "modules x1, x2, x3 in this order, policies [0,1,1], [1,0,1], [1,1,0]", good, n
    )
    return Findings(lines, [claim])


def draw(trials: Sequence[Trial], folder: Path) -> list[Path]:
    """The paper's four panels, and the saved policies of each module."""
    drawn, axes = panels.figure(2, 2)
    panels.eta_dot(axes[0, 0], trials, learner_config().delta, "a")
    panels.rewards(axes[0, 1], trials, "b", "R, stay entries")
    panels.values(axes[1, 0], trials, "c")
    panels.policies(axes[1, 1], trials, "d", "policy, mean and SD")
    paths = panels.save(drawn, folder, "oscillatory")
    bars, axes = panels.figure(1, 3, width=2.3)
    for i in range(3):
        words = [t.row["policies"][i] for t in trials if len(t.row["policies"]) > i]
        saved = [np.array([*map(int, word)]) for word in words]
        if saved:
            panels.policy_bars(axes[0, i], saved, "abc"[i], f"module {i + 1}")
    return paths + panels.save(bars, folder, "oscillatory-policies")
