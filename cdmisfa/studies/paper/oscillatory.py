"""The oscillatory streams: what is learned in which order, and CD-MISFA 1.0 against 2.0."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cdmisfa import kernels
from cdmisfa.agents.agent import OUTCOME, Frozen, as_struct, new_agent, rules
from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.config import LearnerConfig, build, load_preset
from cdmisfa.core.expansion import quadratic
from cdmisfa.experiments.results import summary
from cdmisfa.experiments.trial import run_trial
from cdmisfa.kernels import instantaneous_slowness
from cdmisfa.modules import Module
from cdmisfa.studies import pages
from cdmisfa.studies.paper.experiment import (
    Experiment,
    Findings,
    Output,
    Request,
    Settings,
    Trial,
    first_above,
    groups,
    learned_order,
    mean_of,
    module_row,
)
from recorder.world.oscillatory import one_period

STREAMS = ("x1", "x2", "x3")

MAX_ITERATIONS = 10_000

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


def stay_rewards(curves: Mapping[str, Any], config: LearnerConfig) -> dict[str, list[float]]:
    """What staying in each of three streams earns while the first policy is found, in the mean.

    That is what the paper's agent itself goes by: the easier a stream, the faster the weights
    settle there. Once epsilon is below its knee the agent mostly stays where it likes it.

    Args:
        curves: (N,) `stream`, `epsilon`, `curiosity` and `reward` of the iterations.
        config: the learner's.

    Returns:
        Of `curiosity`, its part, and of the whole `reward`: (3,), NaN of a stream without one.
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
            **stay_rewards(curves, config),
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
        earned = np.array([t.row["curiosity"] for t in trials]).T
        for name, values in zip(STREAMS, earned, strict=True):
            quantity = f"curiosity reward of a stay in {name}, while exploring"
            found.measured(quantity, values, digits=5)
        order = "modules x1, x2, x3 in this order, policies [0,1,1], [1,0,1], [1,1,0]"
        found.claim_all(order, good, n)
        one, two, three = earned
        falls = first_above(one, two) and first_above(two, three)
        means = ", ".join(f"{value:.5f}" for value in earned.mean(axis=1))
        found.claim("x1 earns more curiosity reward than x2, and x2 than x3", falls, means)
        found.sum_up(
            "The order on the oscillatory streams",
            f"modules x1, x2, x3 with the optimal policies in {good} of {n} trials (paper: 20 of "
            "20).",
        )

    def draw(self, trials: Sequence[Trial], folder: Path) -> list[Path]:
        """The paper's four panels."""
        figure, axes = pages.new_figure(2, 2)
        names = ("eta_dot", "R", "Q", "policy")
        eta_dot, R, Q, policy = ([t.arrays[name] for t in trials] for name in names)
        pages.draw_eta_dot(axes[0, 0], eta_dot, paper_config("oscillatory").delta, "a")
        pages.draw_rewards(axes[0, 1], R, "b", "R, stay entries")
        pages.draw_value_gains(axes[1, 0], Q, "c")
        pages.draw_policies(axes[1, 1], policy, "d", "share of trials that stay")
        return pages.save_figure(figure, folder, "oscillatory")


class FiveStreams(Experiment):
    """The paper's example of five streams: the third is the easiest, the first the next."""

    title = "Five streams"
    streams = ("x2", "x3", "x1", "x3", "x3")
    """The easiest is the third, the next the first, the others are as hard."""
    optimal = ((2, "11011"), (0, "01111"))
    """Stream and policy of the first two modules, as the paper's example gives them."""

    def run(self, settings: Settings) -> Output:
        """One trial until nothing is left to learn."""
        config, seed = paper_config("oscillatory"), settings["seed"]
        result = run_trial(config, self.streams, seed=seed, max_iterations=MAX_ITERATIONS)
        return module_row(result.modules), {}

    def evaluate(self, trials: Sequence[Trial], found: Findings) -> None:
        """Every trial must learn the third stream, then the first, with the example's policies."""
        good, n = sum(learned_order(t.row)[:2] == self.optimal for t in trials), len(trials)
        third = [[self.streams[s] for s in t.row["streams"][2:]] for t in trials]
        found.share("trials with both policies as in the example", "all (text)", good, n)
        for i, (stream, _) in enumerate(self.optimal):
            quantity = f"module {i + 1} (stream {stream + 1}) saved at iteration"
            found.of_module(quantity, trials, "saved_at", i, digits=0)
        found.claim_all("five streams: policies [1,1,0,1,1], then [0,1,1,1,1]", good, n)
        encode = "a module may encode several streams: one for all three x3, and no fourth module"
        found.claim_all(encode, sum(streams == ["x3"] for streams in third), n)
        found.notes.append(f"The paper names no streams; these show {', '.join(self.streams)}.")


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
        figure, axes = pages.new_figure(2, 2)
        for row, algorithm in enumerate(ALGORITHMS):
            one = groups(trials, "algorithm")[algorithm,][0]
            reward, policy = ([one.arrays[name]] for name in ("R", "policy"))
            pages.draw_rewards(axes[row, 0], reward, "ac"[row], f"{algorithm}: R, stay entries")
            pages.draw_policies(axes[row, 1], policy, "bd"[row], f"{algorithm}: stays on")
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
        rows, ratios = [], []
        for (streams, modules), group in groups(trials, "streams", "modules").items():
            own = [np.array([t.row[f"own_{a}"] for t in group]) for a in ALGORITHMS]
            row = [f"{streams}, {modules}", *(mean_of(times, 2) for times in own)]
            row.append(mean_of(own[0] / own[1], 2))
            if not modules:
                whole = [np.array([t.row[f"whole_{a}"] for t in group]) for a in ALGORITHMS]
                ratios.append(summary(whole[0] / whole[1]).mean)
                row += [mean_of(whole[1], 1), mean_of(whole[0] / whole[1], 3)]
            rows.append(row + ["-"] * (6 - len(row)))
        head = ("streams, frozen modules", "only 1.0, us", "only 2.0, us", "1.0 over 2.0 in these")
        found.table((*head, "iteration of 2.0, us", "1.0 over 2.0 in iterations"), rows)
        old, new = (len(used_keys(name)) for name in ALGORITHMS)
        listed = len(LISTED)
        instead = len(set(LISTED) - set(OWN_KEYS["2.0"])) + len(OWN_KEYS["1.0"])
        found.claim(
            "2.0 is computationally less expensive, by the whole iteration",
            min(ratios) > 1.0,
            f"1.0 takes {' and '.join(f'{ratio:.3f}' for ratio in ratios)} times as long",
        )
        found.claim(
            "2.0 has fewer hyper-parameters",
            new < old and listed < instead,
            f"{listed} against {instead} in the paper's terms, {new} against {old} keys; 1.0 "
            "needs labels, too",
        )
        found.notes.append(
            "CPU time of a block of the work that only one of the two does, and of a whole "
            "iteration; that of 1.0 is told by its parts."
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
