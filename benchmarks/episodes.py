"""`cdmisfa episodes` on simulated episodes with planted faults: which does it flag."""

from __future__ import annotations

import json
import tempfile
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.report import save
from benchmarks.robot_episodes import CAMERAS, FAULTS, TASKS, dataset, make_pool
from cdmisfa.core.processes import run_all
from replay.episodes.ranking import Ranked, rank_episodes

SEED = 51
"""Of the episodes; constants were set on seed 31 of the same tasks, and on other tasks."""

FAULTY = 0.18
"""Share of faulty episodes in a dataset."""

Episode = dict[str, Any]


def auroc(bad: Sequence[float], good: np.ndarray) -> float:
    """Return the probability that a faulty episode has a higher score than a good one."""
    scores = np.asarray(bad)[:, None]
    return float(((scores > good) + 0.5 * (scores == good)).mean())


def pools(folder: Path, good: int, each: int) -> None:
    """Simulate two sessions of each task, the second without faults."""
    tasks = [
        (folder / ("b" if session else "a") / task, task, session)
        for task in TASKS
        for session in (0, 1)
    ]
    work = [(path, task, SEED, good, 0 if session else each, session)
            for path, task, session in tasks]  # fmt: skip
    for _ in run_all(_pool, work, jobs=2):
        pass


def _pool(arguments: Any) -> None:
    make_pool(*arguments)


def listed(pool: Path, task: str) -> list[Episode]:
    """Return the episodes of a pool."""
    rows: list[Episode] = json.loads((pool / task / "pool.json").read_text())
    return [{**row, "pool": str(pool)} for row in rows]


def ranked(folder: Path, name: str, episodes: Sequence[Episode]) -> Ranked:
    """Assemble a dataset and rank its episodes."""
    dataset(folder / name, episodes, CAMERAS)
    result = rank_episodes([folder / name], folder / f"{name}-ranked", jobs=2)
    assert result is not None
    return result


def with_faults(folder: Path, rng: np.random.Generator) -> tuple[list[list[object]], list[object]]:
    """Rank datasets that hold every fault of the pool once; return rows by fault, and totals."""
    areas, flags = defaultdict[str, list[float]](list), defaultdict[str, list[bool]](list)
    alarms, precision, late = list[bool](), list[float](), list[bool]()
    for task in TASKS:
        pool = listed(folder / "a", task)
        good = [episode for episode in pool if not episode["fault"]]
        bad = [episode for episode in pool if episode["fault"]]
        rng.shuffle(bad)
        size = round(len(good) * FAULTY / (1 - FAULTY))
        for at in range(0, len(bad), size):
            part = bad[at : at + size]
            bases = {episode["base"] for episode in part}
            chosen = [*(one for one in good if one["name"] not in bases), *part]
            result = ranked(folder, f"{task}{at}", chosen)
            is_good = np.array([not episode["fault"] for episode in chosen])
            score = result.score
            alarms += (score[is_good] >= 1).tolist()
            worst = result.order[: len(chosen) // 10]
            precision.append(1 - float(is_good[worst].mean()))
            for place, episode in enumerate(chosen):
                if fault := episode["fault"]:
                    areas[fault].append(auroc([score[place]], score[is_good]))
                    flags[fault].append(bool(score[place] >= 1))
                lags = [c.value[place] for c in result.columns if c.reason == "lag"]
                late += [abs(lag - episode["lag"]) < 1.5 / 25 for lag in lags if np.isfinite(lag)]
    rows: list[list[object]] = [
        [fault, len(areas[fault]), round(float(np.mean(areas[fault])), 3),
         f"{np.mean(flags[fault]):.0%}"]
        for fault in FAULTS
    ]  # fmt: skip
    every = [area for values in areas.values() for area in values]
    hits = [flag for values in flags.values() for flag in values]
    total: list[object] = [round(float(np.mean(every)), 4), f"{np.mean(hits):.0%}"]
    total += [f"{np.mean(alarms):.1%}", round(float(np.mean(precision)), 3)]
    total.append(f"{np.mean(late):.1%}")
    return rows, total


def without_faults(folder: Path, rng: np.random.Generator) -> list[list[object]]:
    """Rank good datasets: small ones, two sessions, two tasks; return the share that is flagged."""
    rows = list[list[object]]()
    kinds: dict[str, list[list[Episode]]] = {"one session": [], "two sessions": [], "two tasks": []}
    good = {
        (pool, task): [one for one in listed(folder / pool, task) if not one["fault"]]
        for pool in "ab"
        for task in TASKS
    }
    for place, task in enumerate(TASKS):
        first, second = good["a", task], good["b", task]
        for size in (10, 15, 25, len(first)):
            kinds["one session"].append([*rng.permutation(np.array(first, object))[:size]])
        kinds["two sessions"] += [[*first[:20], *second[:6]], [*first[:12], *second[:12]]]
        unlike = [
            {**one, "label": "task"} for one in [*first[:16], *good["a", TASKS[place - 1]][:8]]
        ]
        kinds["two tasks"].append(unlike)
    for kind, sets in kinds.items():
        flagged = [
            bool(score >= 1)
            for place, chosen in enumerate(sets)
            for score in ranked(folder, f"{kind.replace(' ', '-')}{place}", chosen).score
        ]
        rows.append([kind, len(sets), len(flagged), f"{np.mean(flagged):.1%}"])
    return rows


def main(*, quick: bool = False) -> None:
    """Measure, and write results/episodes.json."""
    rng = np.random.default_rng(SEED)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        pools(folder, 16 if quick else 40, 1 if quick else 3)
        rows, total = with_faults(folder, rng)
        good = without_faults(folder, rng)
    save(
        "episodes",
        "Bad episodes of a dataset",
        f"Simulated episodes of a Kuka arm with two cameras, AV1-coded as LeRobot does: "
        f"{FAULTY:.0%} of a dataset are faulty. AUROC is the probability that a faulty episode has "
        "a higher score than a good one of its dataset. Lags are right within one frame. Limits "
        "were set on other seeds and in part on other tasks.",
        [
            (["fault", "episodes", "AUROC", "flagged"], rows),
            (["AUROC", "faulty flagged", "good flagged", "precision in the worst 10 %",
              "lags right"], [total]),
            (["good datasets of", "datasets", "episodes", "flagged"], good),
        ],
    )  # fmt: skip
