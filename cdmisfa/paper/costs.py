"""CD-MISFA 1.0 against 2.0: what an iteration costs, and how many numbers are to be chosen."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.agents.agent import Agent, Rules, new_agent, rules
from cdmisfa.agents.gate import verdict
from cdmisfa.agents.reward import add_reward, add_reward_locally
from cdmisfa.agents.roc import known_to
from cdmisfa.agents.saving import track_clusters, track_output
from cdmisfa.core.arithmetic.compiled import compiled
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

Float = NDArray[np.float64]


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

    iterate(1)  # compiles
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
    agent, constants = new_agent(config, streams, 0), rules(config, streams)
    centres = np.zeros((modules, *agent.centres.shape))
    counts = np.zeros((modules, *agent.counts.shape))
    if algorithm == "1.0" and modules:
        _clustering(agent, constants, y, y_frozen[:, :0], centres[:0], counts[:0], PHASES)
        centres[:], counts[:] = agent.centres, agent.counts

    def repeat(blocks: int) -> None:
        if algorithm == "1.0":
            _clustering(agent, constants, y, y_frozen, centres, counts, blocks)
        else:
            _slowness(agent, constants, y, y_frozen, blocks)

    def tell(blocks: int) -> float:
        repeat(1)  # compiles
        return _timed(repeat, blocks)

    return tell


@compiled
def _slowness(agent: Agent, constants: Rules, y: Float, y_frozen: Float, blocks: int) -> None:
    """2.0's own work: slowness of the output and of the modules', and the running reward."""
    modules = y_frozen.shape[1]
    band, eta_inst = np.zeros((modules, 1)), np.zeros((modules, 1))
    for k in range(blocks):
        block = k % len(y)
        agent.memory[0]["novel_blocks"] += 1
        track_output(agent, constants, 0, y[block, :, 0])
        agent.y_frames[0] += y.shape[1]
        verdict(y_frozen[block], band, band, eta_inst)
        s = k % len(agent.policy)
        add_reward(agent.stay_sum, agent.switch_sum, agent.dense, s, 0, s, 0.001)


@compiled
def _clustering(
    agent: Agent,
    constants: Rules,
    y: Float,
    y_frozen: Float,
    centres: Float,
    counts: Float,
    blocks: int,
) -> None:
    """1.0's own work: clusters of the output and of the modules', and the tabular reward."""
    error = np.zeros(y_frozen.shape[1])
    for k in range(blocks):
        block = k % len(y)
        agent.memory[0]["novel_blocks"] += 1
        s = k % len(agent.policy)
        track_clusters(agent, constants, s, y[block])
        known_to(centres, counts, s, y_frozen[block], constants.roc_error, error)
        add_reward_locally(
            agent.stay_sum, agent.switch_sum, agent.dense, s, 0, s, 0.001, constants.alpha
        )


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
