"""rdq, robot-data-audit and kalanos on the same simulated datasets as `cdmisfa episodes`.

EPISODE_PEERS names an environment in which they and PyAV are installed, such as
    python -m venv peers && peers/bin/pip install 'rdq[video]' robot-data-audit 'kalanos[video]'
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.episodes import SEED, auroc, listed, measured, pools, pools_folder, ranked
from benchmarks.report import save
from benchmarks.robot_bench import Bench
from benchmarks.robot_episodes import FAULTS, dataset

_VERDICTS: Final = ("PASS", "REVIEW", "EXCLUDE")


def _rdq(report: Any) -> list[float]:
    if "score" in report:  # of `check`
        return [-score for score in report["score"]["episode_scores"].values()]
    return [-(episode["composite"] or 0) for episode in report["episodes"].values()]


def _rda(report: Any) -> list[float]:
    """Order by verdict, and among the same verdict by the number of findings."""
    return [100 * _VERDICTS.index(episode["verdict"])
            + sum(metric["has_finding"] for metric in episode["metrics"].values())
            for episode in report["episodes"]]  # fmt: skip


def _kalanos(report: Any) -> list[float]:
    """Order by readiness, blocked episodes first."""
    return [100 * (episode["eligibility"]["status"] == "blocked") - (episode["score"]["score"] or 0)
            for episode in report["episodes"]]  # fmt: skip


# Command of each tool, and how bad its report takes each episode to be.
# `rdq check --video-full` was not done after 1,000 s of a dataset that takes 2 s with `--video`.
TOOLS: Final[dict[str, tuple[str, Callable[[Any], list[float]]]]] = {
    "rdq check": ("rdq check {data} --video --json {out}", _rdq),
    "rdq rank": ("rdq rank {data} --all --json {out}", _rdq),
    "robot-data-audit": ("rda audit {data} --full --freeze-motion-source auto --format json "
                         "--output {out}", _rda),
    "kalanos": ("kalanos grade {data} --tier full --profile vision-imitation-v1 --report {out}",
                _kalanos),
}  # fmt: skip


def judge(tool: str, data: Path, count: int) -> list[float] | None:
    """Return how bad a tool takes each episode to be; None, with a line, without an answer."""
    command, badness = TOOLS[tool]
    out = data.with_name(f"{data.name}-{tool.replace(' ', '-')}.json")
    words = command.format(data=data, out=out).split()
    program = Path(os.environ.get("EPISODE_PEERS", "")) / "bin" / words[0]
    errors = ""
    if not out.exists():
        if not program.exists():
            return print(f"{tool}: no {program}")
        result = subprocess.run([program, *words[1:]], capture_output=True, text=True, check=False)
        errors = result.stderr[-500:]
    scores = badness(json.loads(out.read_text())) if out.exists() else []
    if len(scores) != count:
        return print(f"{tool}: {len(scores)} of {count} episodes: {errors}")
    return scores


def main(*, quick: bool = False) -> None:
    """Measure, and write results/episode_peers.json; `quick` takes the first task only."""
    folder = pools_folder()
    pools(folder, [Bench])
    areas: dict[str, dict[str, list[float]]] = {}
    for task in Bench.tasks[: 1 if quick else None]:
        pool = listed(folder / "a", task)
        bad = [*{one["fault"]: one for one in pool if one["fault"]}.values()]
        bases = {one["base"] for one in bad}
        chosen = [one for one in pool if not one["fault"] and one["name"] not in bases] + bad
        data = folder / f"{task}-peers"
        shutil.rmtree(data, ignore_errors=True)
        dataset(data, chosen, Bench.cameras)
        ours = ranked(measured(folder, Bench, task), chosen).score
        answers = {"cdmisfa": ours, **{tool: judge(tool, data, len(chosen)) for tool in TOOLS}}
        good = np.array([not one["fault"] for one in chosen])
        for tool, scores in answers.items():
            if scores is not None:
                for episode, score in zip(chosen, scores, strict=True):
                    if fault := episode["fault"]:
                        area = auroc([score], np.asarray(scores)[good])
                        areas.setdefault(tool, {}).setdefault(fault, []).append(area)
    rows = [[fault, *(round(float(np.mean(a[fault])), 2) for a in areas.values())]
            for fault in FAULTS]  # fmt: skip
    means = [np.mean([*a.values()]) for a in areas.values()]
    rows.append(["all", *(round(float(mean), 3) for mean in means)])
    save(
        "episode_peers",
        "Bad episodes: other tools",
        "AUROC of a fault against the good episodes of its dataset, one episode of each fault a "
        "task. The own score or the findings of a tool order the episodes; `rdq check` decodes a "
        f"few images of each. Arm, tasks and cameras are those of the bench, seed {SEED}.",
        [(["fault", *areas], rows)],
    )
