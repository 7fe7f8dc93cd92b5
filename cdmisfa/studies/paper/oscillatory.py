"""The oscillatory streams: modules in the order of difficulty, with their policies."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.config import LearnerConfig, build, load_preset
from cdmisfa.core.expansion import quadratic
from cdmisfa.core.modules import Module
from cdmisfa.experiments.trial import run_trial
from cdmisfa.kernels import instantaneous_slowness
from cdmisfa.studies import pages
from cdmisfa.studies.paper import panels
from cdmisfa.studies.paper.experiment import (
    Experiment,
    Findings,
    Output,
    Settings,
    Trial,
    learned_order,
    module_row,
)
from recorder.world.oscillatory import one_period

STREAMS = ("x1", "x2", "x3")

MAX_ITERATIONS = 10_000


def paper_config(scene: str, **keys: Any) -> LearnerConfig:
    """The preset of a scene with some keys set."""
    return build(LearnerConfig, "learner", load_preset(scene)["learner"], keys)


def expanded_period(stream: int) -> FloatArray:
    """One period of a stream as the learner sees it, (500, 5)."""
    return quadratic(one_period(STREAMS[stream]))


def slowness_on(module: Module) -> float:
    """Slowness of a module's output on one period of its own stream, in cycles per frame."""
    x = expanded_period(module.stream_index)
    return float(instantaneous_slowness((x - module.mean) @ module.phi[:1].T)[0])


class Oscillatory(Experiment):
    """Three modules in the order of difficulty."""

    title = "Oscillatory streams"
    optimal = ((0, "011"), (1, "101"), (2, "110"))
    """Stream and policy of each module, as the paper gives them."""

    def run(self, settings: Settings) -> Output:
        """One trial until three modules are learned."""
        config, seed = paper_config("oscillatory"), settings["seed"]
        result = run_trial(config, seed=seed, max_iterations=MAX_ITERATIONS, curves=True)
        curves: Any = result.curves
        modules = module_row(result.modules)
        row = {
            "optimal": learned_order(modules) == self.optimal,
            "iterations": result.iterations,
            **modules,
            "eta": [slowness_on(m) for m in result.modules],
        }
        arrays = {name: curves[name].astype(np.float32) for name in ("eta_dot", "R", "Q")}
        return row, {**arrays, "policy": curves["policy"].astype(np.int8)}

    def evaluate(self, trials: Sequence[Trial], found: Findings) -> None:
        """Every trial must learn x1, x2, x3 in this order with the optimal policies."""
        good, n = sum(bool(t.row["optimal"]) for t in trials), len(trials)
        iterations = [t.row["iterations"] for t in trials]
        found.share("trials with order and policies optimal", "20 of 20 (text)", good, n)
        found.measured("iterations until the third module", iterations, digits=0)
        for i, frequency in enumerate((4, 3, 2)):
            module, paper = f"module {i + 1}", f"{frequency / 500:.4f} (equation)"
            slowness = f"slowness of {module} on its stream (paper: its frequency)"
            found.of_module(f"{module} saved at iteration", trials, "saved_at", i, digits=0)
            found.of_module(slowness, trials, "eta", i, paper, digits=4)
        order = "modules x1, x2, x3 in this order, policies [0,1,1], [1,0,1], [1,1,0]"
        found.claim_all(order, good, n)

    def draw(self, trials: Sequence[Trial], folder: Path) -> list[Path]:
        """The paper's four panels, and the saved policies of each module."""
        figure, axes = panels.figure_of_panels(2, 2)
        panels.eta_dot(axes[0, 0], trials, paper_config("oscillatory").delta, "a")
        panels.rewards(axes[0, 1], trials, "b", "R, stay entries")
        panels.value_gains(axes[1, 0], trials, "c")
        panels.policies(axes[1, 1], trials, "d", "policy, mean and SD")
        paths = pages.save_figure(figure, folder, "oscillatory")
        bars, axes = panels.figure_of_panels(1, 3, width=2.3)
        for i in range(3):
            words = [t.row["policies"][i] for t in trials if len(t.row["policies"]) > i]
            if words:
                panels.policy_bars(axes[0, i], words, "abc"[i], f"module {i + 1}")
        return paths + pages.save_figure(bars, folder, "oscillatory-policies")


class FiveStreams(Experiment):
    """The paper's example of five streams: the third is the easiest, the first the next."""

    title = "Five streams"
    streams = ("x2", "x3", "x1", "x3", "x3")
    """The easiest is the third, the next the first, the others are as hard."""
    optimal = ((2, "11011"), (0, "01111"))
    """Stream and policy of the first two modules, as the paper's example gives them."""

    def run(self, settings: Settings) -> Output:
        """One trial until two modules are learned."""
        result = run_trial(
            paper_config("oscillatory"),
            self.streams,
            seed=settings["seed"],
            max_iterations=MAX_ITERATIONS,
            max_modules=len(self.optimal),
        )
        return module_row(result.modules), {}

    def evaluate(self, trials: Sequence[Trial], found: Findings) -> None:
        """Every trial must learn the third stream, then the first, with the example's policies."""
        good, n = sum(learned_order(t.row) == self.optimal for t in trials), len(trials)
        found.share("trials with both policies as in the example", "all (text)", good, n)
        for i, (stream, _) in enumerate(self.optimal):
            quantity = f"module {i + 1} (stream {stream + 1}) saved at iteration"
            found.of_module(quantity, trials, "saved_at", i, digits=0)
        found.claim_all("policies [1,1,0,1,1], then [0,1,1,1,1]", good, n)
        found.notes.append(f"The paper names no streams; these show {', '.join(self.streams)}.")
