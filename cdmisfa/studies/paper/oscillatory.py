"""The oscillatory streams: the order of learning, and CD-MISFA 1.0 against 2.0."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.expansion import quadratic
from cdmisfa.experiments.results import summary
from cdmisfa.experiments.trial import run_oscillatory_trial
from cdmisfa.kernels import instantaneous_slowness
from cdmisfa.modules import Module
from cdmisfa.studies.paper import figures
from cdmisfa.studies.paper.experiment import (
    Experiment,
    Findings,
    Output,
    Settings,
    Trial,
    first_above,
    groups,
    learned_order,
    module_row,
    paper_config,
)
from recorder.world.oscillatory import one_period

STREAMS = ("x1", "x2", "x3")

MAX_ITERATIONS = 10_000

ALGORITHMS = ("1.0", "2.0")

# About 200 iterations of exploration, and 1000 after epsilon is set to 0.
ITERATIONS = 1200

# Thresholds at which no module is saved, so that only the policy is tested.
NEVER = {"delta": 1e-12, "roc_error": 0.0}


def slowness_on(module: Module) -> float:
    """Return the slowness of a module's output on one period of its own stream, in 1/frame."""
    x = quadratic(one_period(STREAMS[module.stream_index]))
    return float(instantaneous_slowness((x - module.mean) @ module.phi[:1].T)[0])


def stay_rewards(curves: Mapping[str, Any], config: LearnerConfig) -> dict[str, list[float]]:
    """Return the mean reward for staying in each of three streams while the agent explores.

    The agent of the paper chooses by this reward: the easier a stream, the faster its weights
    settle. When epsilon is below its knee, the agent mostly stays in its preferred stream.

    Args:
        curves: (N,) `stream`, `epsilon`, `curiosity` and `reward` of the iterations.
        config: configuration of the learner.

    Returns:
        Means of `curiosity`, a part of the reward, and of `reward`: (3,), NaN for a stream without.
    """
    streams, epsilon = np.asarray(curves["stream"]).astype(int), np.asarray(curves["epsilon"])
    end = int(np.argmax(epsilon < config.epsilon_knee)) or len(epsilon)
    at = np.arange(1, end)
    stayed = at[(streams[at] == streams[at - 1]) & np.isfinite(curves["reward"][at])]
    return {
        name: [summary(curves[name][stayed[streams[stayed] == s]]).mean for s in range(3)]
        for name in ("curiosity", "reward")
    }


class Oscillatory(Experiment):
    """Three modules in the order of difficulty."""

    title = "Oscillatory streams"
    # Stream and policy of each module, as the paper gives them.
    optimal = ((0, "011"), (1, "101"), (2, "110"))

    def run(self, settings: Settings) -> Output:
        """Learn until three modules are saved."""
        config = paper_config("oscillatory")
        result = run_oscillatory_trial(
            config, seed=settings["seed"], max_iterations=MAX_ITERATIONS, curves=True
        )
        curves: Any = result.curves
        row = {
            "iterations": result.iterations,
            **module_row(result.modules),
            "eta": [slowness_on(m) for m in result.modules],
            **stay_rewards(curves, config),
        }
        return row, {name: curves[name] for name in ("eta_dot", "R", "Q", "policy")}

    def evaluate(self, trials: Sequence[Trial], findings: Findings) -> None:
        """Check that every trial learned x1, x2, x3 in this order with the optimal policies."""
        good, n = sum(learned_order(t.row) == self.optimal for t in trials), len(trials)
        findings.share("trials with order and policies optimal", "20 of 20 (text)", good, n)
        iterations = [t.row["iterations"] for t in trials]
        findings.measured("iterations until the third module", iterations, digits=0)
        for i, frequency in enumerate((4, 3, 2)):
            learned = [t.row for t in trials if len(t.row["streams"]) > i]
            saved, eta = ([row[key][i] for row in learned] for key in ("saved_at", "eta"))
            findings.measured(f"module {i + 1} saved at iteration", saved, digits=0)
            slowness = f"slowness of module {i + 1} on its stream (paper: its frequency)"
            findings.measured(slowness, eta, f"{frequency / 500:.4f} (equation)", digits=4)
        earned = np.array([t.row["curiosity"] for t in trials]).T
        for name, values in zip(STREAMS, earned, strict=True):
            quantity = f"curiosity reward of a stay in {name}, while exploring"
            findings.measured(quantity, values, digits=5)
        order = "modules x1, x2, x3 in this order, policies [0,1,1], [1,0,1], [1,1,0]"
        findings.claim_all(order, good, n)
        one, two, three = earned
        falls = first_above(one, two) and first_above(two, three)
        means = ", ".join(f"{value:.5f}" for value in earned.mean(axis=1))
        findings.claim("x1 earns more curiosity reward than x2, and x2 than x3", falls, means)

    def draw(self, trials: Sequence[Trial], folder: Path) -> list[Path]:
        """Draw the paper's four panels."""
        figure, axes = figures.new_figure(2, 2)
        names = ("eta_dot", "R", "Q", "policy")
        eta_dot, R, Q, policy = ([t.arrays[name] for t in trials] for name in names)
        figures.draw_eta_dot(axes[0, 0], eta_dot, paper_config("oscillatory").delta, "a")
        figures.draw_means(axes[0, 1], R, "b", "reward for staying")
        figures.draw_means(axes[1, 0], gains(Q), "c", GAIN)
        figures.draw_policies(axes[1, 1], policy, "d", "share of trials that stay")
        return [figures.save_figure(figure, folder, "oscillatory")]


GAIN = "advantage of staying"


def gains(Q: figures.Curves) -> figures.Curves:
    """Return the advantage of staying over switching, from Q (N, S, 2) of each trial."""
    return [curve[:, :, 0] - curve[:, :, 1] for curve in Q]


class FiveStreams(Experiment):
    """The paper's example of five streams: the third is the easiest, the first the next."""

    title = "Five streams"
    # The paper names no streams; the last two are as hard as the second.
    streams = ("x2", "x3", "x1", "x3", "x3")
    # Stream and policy of the first two modules, as the paper's example gives them.
    optimal = ((2, "11011"), (0, "01111"))

    def run(self, settings: Settings) -> Output:
        """Learn until nothing is left."""
        config, seed = paper_config("oscillatory"), settings["seed"]
        result = run_oscillatory_trial(
            config, self.streams, seed=seed, max_iterations=MAX_ITERATIONS
        )
        return module_row(result.modules), {}

    def evaluate(self, trials: Sequence[Trial], findings: Findings) -> None:
        """Check that every trial learned the third stream, then the first, with these policies."""
        good, n = sum(learned_order(t.row)[:2] == self.optimal for t in trials), len(trials)
        third = [[self.streams[s] for s in t.row["streams"][2:]] for t in trials]
        findings.share("trials with both policies as in the example", "all (text)", good, n)
        for i, (stream, _) in enumerate(self.optimal):
            quantity = f"module {i + 1} (stream {stream + 1}) saved at iteration"
            saved = [t.row["saved_at"][i] for t in trials if len(t.row["saved_at"]) > i]
            findings.measured(quantity, saved, digits=0)
        findings.claim_all("five streams: policies [1,1,0,1,1], then [0,1,1,1,1]", good, n)
        encode = "a module may encode several streams: one for all three x3, and no fourth module"
        findings.claim_all(encode, sum(streams == ["x3"] for streams in third), n)
        findings.notes.append(f"The paper names no streams; these show {', '.join(self.streams)}.")


class Stability(Experiment):
    """Stability of the policies of 1.0 and 2.0 after exploration has ended."""

    title = "CD-MISFA 1.0 against 2.0"
    trials = (20, 3)

    def conditions(self, quick: bool, recording: Path | None) -> list[Settings]:
        """Return each algorithm."""
        return [{"algorithm": algorithm} for algorithm in ALGORITHMS]

    def run(self, settings: Settings) -> Output:
        """Let epsilon fall to 0.8 and then be 0; count the changes of the policy from there on."""
        keys = {"algorithm": settings["algorithm"], "epsilon_decay": 0.998}
        config = paper_config("oscillatory", **keys, epsilon_tail_decay=0.0, **NEVER)
        result = run_oscillatory_trial(
            config, seed=settings["seed"], max_iterations=ITERATIONS, max_modules=1, curves=True
        )
        curves: Any = result.curves
        still, policy = int(np.argmax(curves["epsilon"] == 0.0)), curves["policy"]
        row = {
            "exploration_ends": still,
            "changes": int((np.diff(policy[still:], axis=0) != 0).any(axis=1).sum()),
            "after": "".join(map(str, policy[-1])),
        }
        return row, {name: curves[name] for name in ("R", "policy")}

    def evaluate(self, trials: Sequence[Trial], findings: Findings) -> None:
        """Check that 2.0 never changes its policy, and 1.0 at least once in every trial."""
        old, new = (groups(trials, "algorithm")[a,] for a in ALGORITHMS)
        changes, n = [t.row["changes"] for t in old], len(new)
        unstable = sum(c > 0 for c in changes)
        stable = sum(t.row["changes"] == 0 for t in new)
        optimal = sum(t.row["after"] == "011" for t in new)
        changed, paper = "1.0: changes of policy after epsilon = 0", "all (figure)"
        findings.share("2.0: trials without a change of policy", paper, stable, n)
        findings.share("1.0: trials with a change of policy", paper, unstable, n)
        findings.measured(changed, changes, ">= 1 (figure)", digits=1)
        findings.share("2.0: trials that end with [0,1,1]", paper, optimal, n)
        findings.claim_all("2.0 keeps its policy after epsilon = 0", stable, n)
        findings.claim_all("1.0 changes its policy after epsilon = 0", unstable, n)

    def draw(self, trials: Sequence[Trial], folder: Path) -> list[Path]:
        """Draw the paper's four panels: one trial's reward function and policy, 1.0 above 2.0."""
        figure, axes = figures.new_figure(2, 2)
        for row, algorithm in enumerate(ALGORITHMS):
            one = groups(trials, "algorithm")[algorithm,][0]
            reward, policy = ([one.arrays[name]] for name in ("R", "policy"))
            figures.draw_means(axes[row, 0], reward, "ac"[row], f"{algorithm}: reward for staying")
            figures.draw_policies(axes[row, 1], policy, "bd"[row], f"{algorithm}: stays on")
            for panel in axes[row]:
                ends = {"color": "grey", "linestyle": ":", "linewidth": 0.8}
                panel.axvline(one.row["exploration_ends"], **ends)
        return [figures.save_figure(figure, folder, "stability")]
