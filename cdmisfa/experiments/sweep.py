"""Sweeps: many trials over a grid of settings and seeds, each computed once.

A sweep that was stopped, or is asked for again with more seeds or a larger grid, computes
what is missing in its folder; see `store`.
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
from cdmisfa.core.untrusted import MAX_LIST
from cdmisfa.experiments.documents import as_text, write_json
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

REQUEST = "sweep.json"
"""What was asked for last."""

UNKEPT = ("schema", "run", "source", "seed", "signals_sha256", "undecided")
"""What of a run's result a trial's row has elsewhere, or not at all."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepTrial(StoredTrial):
    """One run of a sweep, and everything a worker needs to compute it.

    Attributes:
        source: a scene's name, or the paths of a recording.
        configuration: preset, settings, the grid's point and the seed, all together.
        loop: whether a recording starts again at its end.
        inputs: how images of others become frames.
        max_iterations: end after so many.
        max_modules: end after so many.
    """

    source: tuple[str, ...]
    configuration: Configuration
    loop: bool
    inputs: InputOptions
    max_iterations: int | None
    max_modules: int | None


def sweep(
    source: Sequence[str | Path],
    folder: str | Path,
    *,
    grid: Mapping[str, Sequence[Any]] | None = None,
    seeds: Iterable[int] = range(20),
    jobs: int = 1,
    scheduler: str | None = None,
    retry_failed: bool = False,
    progress: Callable[[int, int, int], None] = lambda finished, failed, total: None,
    **how: Any,
) -> SweepReport:
    """Run every trial of a grid that is not finished yet.

    Args:
        source: a scene's name or a recording's paths, as for `learn`.
        folder: where the rows are; made where it does not exist.
        grid: values to try, by configuration key; every combination is a point.
        seeds: every point is tried with each of them.
        jobs: local processes.
        scheduler: address of a dask scheduler, whose workers compute instead.
        retry_failed: compute trials again that failed before.
        progress: called with the trials finished, failed, and asked for.
        how: further arguments of `plan`, for all trials.

    Raises:
        UsageError: a wrong key, value or source, found before any trial starts.
        WorkersError: a worker died, or no scheduler answers.
    """
    folder = Path(folder).resolve()
    if log := next(folder.glob("*.mcap*"), None):
        raise UsageError(f"{folder} holds {log.name}, of a run or a recording: choose another -o")
    trials = plan(source, grid=grid or {}, seeds=seeds, **how)
    request = as_text(_request(grid or {}, trials))
    if len(request) > MAX_LIST:
        raise UsageError(
            f"{len(trials)} trials are more than a folder takes: split them over several -o"
        )
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
    source: Sequence[str | Path],
    *,
    grid: Mapping[str, Sequence[Any]],
    seeds: Iterable[int],
    preset: str | None = None,
    settings: Sequence[str] = (),
    loop: bool = False,
    inputs: InputOptions | None = None,
    max_iterations: int | None = None,
    max_modules: int | None = None,
) -> list[SweepTrial]:
    """Every trial of a sweep, in the grid's order, seeds innermost; checks all settings.

    Args:
        source: see `sweep`.
        grid: see there.
        seeds: see there.
        preset: instead of the source's own.
        settings: `section.key=value` words for all trials.
        loop: start a recording again at its end.
        inputs: how images of others become frames; see `open_source`.
        max_iterations: end each trial after so many.
        max_modules: end each trial after so many.

    Raises:
        UsageError: an unknown key, a value that does not fit, or no such source.
    """
    if keys := [key for key in grid if key.startswith("input.")]:
        raise UsageError(f"grid: {keys[0]} is the same for all trials: give it with --set")
    words = (source,) if isinstance(source, str | Path) else tuple(source)
    if not is_scene(words):
        inputs = read_inputs(inputs, preset, settings)
    inputs = inputs or InputOptions()
    configured, recorded = _configured(words, preset, loop, inputs)
    # Workers may have another working directory.
    scene = recorded is None
    paths = tuple(str(w) if scene or "://" in str(w) else str(Path(w).resolve()) for w in words)
    each = tuple(dict.fromkeys(seeds))
    trials: dict[str, SweepTrial] = {}
    for values in itertools.product(*grid.values()):
        point = dict(zip(grid, values, strict=True))
        words_of = (f"{key}={value}" for key, value in zip(grid, values, strict=True))
        told = configured((*settings, *words_of))
        learner = [section_table(told.learner), _own_code(told.learner.algorithm)]
        for seed in each:
            configuration = told.seeded(seed)
            depends: list[Any] = [*learner]
            if scene:  # the world's part counts only where it is live
                depends.append(configuration.tables())
            if inputs != InputOptions():
                depends.append(dataclasses.asdict(inputs))
            name = trial_id(depends, seed, recorded, [max_iterations, max_modules], code())
            trial = SweepTrial(
                id=name,
                source=paths,
                configuration=configuration,
                point=point,
                seed=seed,
                loop=loop,
                inputs=inputs,
                max_iterations=max_iterations,
                max_modules=max_modules,
                code=code(),
            )
            trials.setdefault(trial.id, trial)
    return list(trials.values())


def _own_code(algorithm: str) -> str:
    """Return a hash of the module of a user's learner, as `code` is of ours; "" for ours."""
    if algorithm in LEARNERS:
        return ""
    module = inspect.getfile(learner_class(algorithm))
    return hashlib.sha256(Path(module).read_bytes()).hexdigest()


def _configured(
    words: tuple[str | Path, ...], preset: str | None, loop: bool, inputs: InputOptions
) -> tuple[Callable[[Sequence[str]], Configuration], dict[str, Any] | None]:
    """The configuration for settings, and what a source says of itself; None of a live scene."""
    if is_scene(words):
        return lambda told: configure(str(words[0]), preset, told, None, inputs), None
    source = open_logs(words, loop=loop, inputs=inputs, goal=("sweep", "SWEEP"))
    with contextlib.closing(source):
        recorded, spec = dict(source.describe()), source.spec
    return lambda told: configure_for(spec, recorded, preset, told, None, inputs), recorded


def compute(trial: SweepTrial) -> Mapping[str, Any]:
    """Compute one trial: its result, or under "error" why there is none.

    Oscillatory trials run as a whole in C where the learner can; all others as `learn` does.
    """
    return answer(trial, code(), _compute)


def _compute(trial: SweepTrial) -> dict[str, Any]:
    live = trial.source == ("oscillatory",)
    if live and has_whole_trials(trial.configuration.learner):
        return _whole_trial(trial)
    return _learned_trial(trial)


def _whole_trial(trial: SweepTrial) -> dict[str, Any]:
    streams = cast(OscillatoryConfig, trial.configuration.scene).streams
    result = run_trial(
        trial.configuration.learner,
        streams,
        seed=trial.seed,
        max_iterations=trial.max_iterations,
        max_modules=trial.max_modules,
    )
    source = trial.configuration.open_scene()
    modules = with_recipes(result.modules, source, source.describe())
    return {
        "iterations": result.iterations,
        "frames": result.frames,
        "modules": [module_table(module) for module in modules],
        "final_policy": list(result.final_policy),
        "epsilon": result.epsilon,
        "ended": result.ended,
    }


def _learned_trial(trial: SweepTrial) -> dict[str, Any]:
    configuration = trial.configuration
    if is_scene(trial.source):
        source = configuration.open_scene()
    else:
        source = open_logs(trial.source, loop=trial.loop, inputs=trial.inputs)
    with contextlib.closing(source):
        result = run(
            source,
            configuration.learner,
            seed=trial.seed,
            max_iterations=trial.max_iterations,
            max_modules=trial.max_modules,
            sections=configuration.tables(),
            rerun=False,
        )
    told = result.as_json()
    return {key: value for key, value in told.items() if key not in UNKEPT}


def _request(grid: Mapping[str, Sequence[Any]], trials: Sequence[SweepTrial]) -> dict[str, Any]:
    return {
        "schema": 1,
        "source": [str(word) for word in trials[0].source] if trials else [],
        "grid": {key: list(values) for key, values in grid.items()},
        "seeds": sorted({trial.seed for trial in trials}),
        "code": code(),
        "trials": [{"id": trial.id, "point": dict(trial.point)} for trial in trials],
    }
