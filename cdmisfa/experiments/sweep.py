"""Sweeps: many trials over a grid of settings and seeds, each computed once.

A sweep that was stopped, or that is asked for again with more seeds or a larger grid, computes the
missing trials in its folder; see `store`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import inspect
import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from cdmisfa.agents.learners import LEARNERS, learner_class
from cdmisfa.core.config import section_table
from cdmisfa.core.errors import UsageError
from cdmisfa.experiments.documents import write_json
from cdmisfa.experiments.run_folder import module_table, with_recipes
from cdmisfa.experiments.session import run
from cdmisfa.experiments.sources import (
    Configuration,
    configure,
    configure_for,
    is_scene,
    open_logs,
    read_inputs,
)
from cdmisfa.experiments.store import (
    StoredTrial,
    SweepReport,
    answer,
    code,
    run_trials,
    trial_id,
)
from cdmisfa.experiments.trial import has_whole_trials, run_trial
from recorder.images.options import InputOptions
from recorder.world.oscillatory import OscillatoryConfig
from replay.runs.folders import REQUEST

UNKEPT = ("schema", "run", "source", "seed", "signals_sha256", "undecided")
"""Keys of a run's result that a trial's row has elsewhere, or not at all."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepTrial(StoredTrial):
    """One run of a sweep, and everything a worker needs to compute it.

    Attributes:
        source: a scene's name, or the paths of logs.
        configuration: preset, settings, the grid's point and the seed together.
        how: `loop` and `inputs` of `open_logs`.
        limits: `max_iterations` and `max_modules`.
    """

    source: tuple[str, ...]
    configuration: Configuration
    how: Mapping[str, Any]
    limits: Mapping[str, Any]


def sweep(
    source: str | Path | Sequence[str | Path],
    folder: str | Path,
    *,
    grid: Mapping[str, Sequence[Any]] | None = None,
    jobs: int = 1,
    scheduler: str | None = None,
    retry_failed: bool = False,
    progress: Callable[[int, int, int], None] = lambda finished, failed, total: None,
    **how: Any,
) -> SweepReport:
    """Run every trial of a grid that is not finished yet.

    Args:
        source: see `plan`, as for `grid` and the further arguments.
        folder: the folder of the rows; made where it does not exist.
        grid: values to try, by configuration key.
        jobs: see `run_trials`, as for `scheduler`, `retry_failed` and `progress`.
        scheduler: address of a dask scheduler.
        retry_failed: compute failed trials again.
        progress: called with the trials finished, failed, and asked for.
        how: further arguments of `plan`.

    Raises:
        UsageError: a wrong key, value or source, found before any trial starts.
        WorkersError: a worker died, or no scheduler answers.
    """
    folder, grid = Path(folder).resolve(), grid or {}
    trials = plan(source, grid=grid, **how)
    request = {
        "schema": 1,
        "source": list(trials[0].source) if trials else [],
        "grid": {key: list(values) for key, values in grid.items()},
        "seeds": sorted({trial.seed for trial in trials}),
        "code": code(),
        "trials": [{"id": trial.id, "point": dict(trial.point)} for trial in trials],
    }
    return run_trials(
        trials,
        folder,
        compute,
        jobs=jobs,
        scheduler=scheduler,
        retry_failed=retry_failed,
        begin=lambda missing: write_json(folder / REQUEST, request),
        progress=progress,
    )


def plan(
    source: str | Path | Sequence[str | Path],
    *,
    grid: Mapping[str, Sequence[Any]],
    seeds: Iterable[int] = range(20),
    preset: str | None = None,
    settings: Sequence[str] = (),
    loop: bool = False,
    inputs: InputOptions | None = None,
    **limits: int | None,
) -> list[SweepTrial]:
    """Return every trial of a sweep, in the grid's order, seeds innermost; check all settings.

    Args:
        source: a scene's name or the paths of logs, as for `learn`.
        grid: values to try, by configuration key; every combination is a point.
        seeds: every point is tried with each of them.
        preset: instead of the source's own.
        settings: `section.key=value` words for all trials.
        loop: start a log again at its end.
        inputs: how images of logs become frames; see `open_source`.
        limits: `max_iterations` and `max_modules`, at which each trial ends.

    Raises:
        UsageError: an unknown key, a value that does not fit, or no such source.
    """
    if keys := [key for key in grid if key.startswith("input.")]:
        raise UsageError(f"grid: {keys[0]} is the same for all trials: give it with --set")
    words = (source,) if isinstance(source, str | Path) else tuple(source)
    scene, recorded = is_scene(words), None
    # Workers may have another working directory.
    paths = tuple(str(w) if scene or "://" in str(w) else str(Path(w).resolve()) for w in words)
    if not scene:
        inputs = read_inputs(inputs, preset, settings)
        with contextlib.closing(
            open_logs(words, loop=loop, inputs=inputs, goal=("sweep", "SWEEP"))
        ) as logs:
            recorded, spec = dict(logs.describe()), logs.spec
    inputs = inputs or InputOptions()
    seeds, ends = tuple(seeds), [limits.get("max_iterations"), limits.get("max_modules")]
    trials: dict[str, SweepTrial] = {}
    for values in itertools.product(*grid.values()):
        point = dict(zip(grid, values, strict=True))
        with_point = (*settings, *(f"{key}={value}" for key, value in point.items()))
        if recorded is None:
            configured = configure(str(words[0]), preset, with_point, None, inputs)
        else:
            configured = configure_for(spec, recorded, preset, with_point, None, inputs)
        learner = configured.learner
        for seed in seeds:
            configuration = configured.seeded(seed)
            depends: list[Any] = [section_table(learner), _user_code(learner.algorithm)]
            if scene:  # of a recording, the world's part does not count
                depends.append(configuration.tables())
            if inputs != InputOptions():
                depends.append(dataclasses.asdict(inputs))
            trial = SweepTrial(
                id=trial_id(depends, seed, recorded, ends, code()),
                source=paths,
                configuration=configuration,
                point=point,
                seed=seed,
                how={"loop": loop, "inputs": inputs},
                limits=limits,
                code=code(),
            )
            trials.setdefault(trial.id, trial)
    return list(trials.values())


def _user_code(algorithm: str) -> str:
    """Return a hash of the module of a user's learner, as `code` is of ours; "" for ours."""
    if algorithm in LEARNERS:
        return ""
    module = inspect.getfile(learner_class(algorithm))
    return hashlib.sha256(Path(module).read_bytes()).hexdigest()


def compute(trial: SweepTrial) -> Mapping[str, Any]:
    """Compute one trial; return its result, or under "error" why there is none."""
    return answer(trial, code(), _compute)


def _compute(trial: SweepTrial) -> dict[str, Any]:
    """Compute an oscillatory trial as a whole in C where the learner can, others as `learn`."""
    configuration, live = trial.configuration, is_scene(trial.source)
    source = configuration.open_scene() if live else open_logs(trial.source, **trial.how)
    with contextlib.closing(source):
        if trial.source == ("oscillatory",) and has_whole_trials(configuration.learner):
            streams = cast(OscillatoryConfig, configuration.scene).streams
            result = run_trial(configuration.learner, streams, seed=trial.seed, **trial.limits)
            modules = with_recipes(result.modules, source, source.describe())
            return {
                "iterations": result.iterations,
                "frames": result.frames,
                "modules": [module_table(module) for module in modules],
                "final_policy": list(result.final_policy),
                "epsilon": result.epsilon,
                "ended": result.ended,
            }
        sections = configuration.tables()
        learned = run(
            source,
            configuration.learner,
            seed=trial.seed,
            sections=sections,
            rerun=False,
            **trial.limits,
        )
    return {key: value for key, value in learned.as_json().items() if key not in UNKEPT}
