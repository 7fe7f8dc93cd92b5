"""Studies beyond the paper's experiments: `python -m benchmarks.paper.NAME`."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from cdmisfa.agents.learners import open_learner
from cdmisfa.experiments.documents import markdown, plain, versions
from cdmisfa.experiments.loop import learn_blocks
from cdmisfa.studies.paper.experiment import Settings, Trial, module_row
from cdmisfa.studies.paper.icub import ITERATIONS, follows, make_recording
from cdmisfa.studies.paper.reproduce import FIRST_SEED

Table = tuple[Sequence[str], Sequence[Sequence[Any]]]


def study(
    name: str,
    conditions: Sequence[Settings],
    run: Callable[[Settings], dict[str, Any]],
    tables: Callable[[Sequence[Trial]], Sequence[Table]],
    trials: int = 10,
) -> None:
    """Run trials, print their tables, and write rows and tables to DIR/NAME.json.

    Args:
        name: of the study.
        conditions: what trials differ in; where `scene` is "icub" and there is no learner, they get
            a `recording` of the scene, made in DIR/icub-recording if it is missing.
        run: computes a trial's row; importable by other processes.
        tables: makes tables of the trials.
        trials: per condition.
    """
    parser = argparse.ArgumentParser(prog=f"python -m benchmarks.paper.{name}")
    parser.add_argument("--trials", type=int, default=trials, help="per condition")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--no-icub", action="store_true", help="leave the iCub out")
    parser.add_argument(
        "-o", "--output", dest="out", type=Path, default=Path("reproduction"), metavar="DIR"
    )
    given = parser.parse_args()
    if given.no_icub:
        conditions = [c for c in conditions if c.get("scene") != "icub"]
    settings = [{**c, "seed": FIRST_SEED + k} for c in conditions for k in range(given.trials)]
    if any(each.get("scene") == "icub" for each in settings):
        recording = make_recording(given.out / "icub-recording", FIRST_SEED, given.jobs)
        settings = [{**each, "recording": str(recording)} for each in settings]
    with ProcessPoolExecutor(given.jobs, get_context("spawn")) as pool:
        rows = list(pool.map(run, settings))
    results = tables([Trial(s, row, {}) for s, row in zip(settings, rows, strict=True)])
    print("\n\n".join(markdown(*table) for table in results))
    document = {"tables": results, "trials": [*zip(settings, rows, strict=True)]}
    given.out.mkdir(parents=True, exist_ok=True)
    text = json.dumps(plain({**document, "versions": versions()}), indent=1)
    (given.out / f"{name}.json").write_text(text + "\n", "utf-8")


def learn_and_judge(source: Any, config: Any, seed: int, frames: int) -> dict[str, Any]:
    """Learn the iCub scene up to a frame; return a row that judges modules on the frames after it.

    Args:
        source: of the scene.
        config: of the learner.
        seed: of the learner.
        frames: to learn from, at most `ITERATIONS` blocks.
    """
    learner = open_learner(config, source.spec, seed)
    iterations = min(ITERATIONS, frames // learner.tau)
    learn_blocks(source, learner, [], max_iterations=iterations, max_modules=iterations)
    return {
        **module_row(learner.modules),
        "iterations": learner.iteration,
        "follows": [follows(module, source, frames) for module in learner.modules],
    }
