"""Sweeps: many trials over a grid of settings and seeds, each computed once.

A sweep that was stopped, or is requested again with more seeds or a larger grid, computes only the
missing trials; see `store`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import inspect
import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, cast

from cdmisfa.agents.learners import LEARNERS, learner_class
from cdmisfa.core.blocks import FrameSource
from cdmisfa.core.config import section_table
from cdmisfa.core.errors import UsageError
from cdmisfa.experiments.documents import write_json
from cdmisfa.experiments.holdout import arrange_frames
from cdmisfa.experiments.run_folder import module_table, with_recipes
from cdmisfa.experiments.session import run_session
from cdmisfa.experiments.sources import (
    Configuration,
    Layers,
    configure,
    configure_for,
    is_scene,
    open_logs,
    read_inputs,
)
from cdmisfa.experiments.store import PlannedTrial, SweepReport, make_trial, run_trials
from cdmisfa.experiments.trial import has_whole_trials, run_oscillatory_trial
from recorder.images.options import InputOptions
from recorder.world.oscillatory import OscillatoryConfig
from replay.runs.folders import REQUEST

# Keys of a run's result that a trial's row stores elsewhere or not at all.
DROPPED_KEYS = ("schema", "run", "source", "seed", "signals_sha256", "undecided", "passes")


def sweep(
    source: str | Path | Sequence[str | Path],
    folder: str | Path,
    *,
    grid: Mapping[str, Sequence[Any]] | None = None,
    **options: Any,
) -> SweepReport:
    """Run every trial of a grid that is not finished yet.

    Args:
        source: see `plan`.
        folder: folder of the rows; it is created if missing.
        grid: values to try, by configuration key.
        options: further arguments of `plan`, and `jobs`, `scheduler`, `retry_failed` and
            `progress` of `run_trials`.

    Raises:
        UsageError: a key, a value or the source is wrong; no trial has started then.
        WorkersError: a worker died.
    """
    folder, grid = Path(folder).resolve(), grid or {}
    words = (source,) if isinstance(source, str | Path) else tuple(source)
    names = ("jobs", "scheduler", "retry_failed", "progress")
    execution = {name: options.pop(name) for name in names if name in options}
    trials = plan(source, grid=grid, **options)
    request = {
        "schema": 1,
        "source": [str(word) for word in words],
        "grid": {key: list(values) for key, values in grid.items()},
        "seeds": sorted({trial.seed for trial in trials}),
        "trials": [{"id": trial.id, "point": dict(trial.point)} for trial in trials],
    }

    def begin(missing: Sequence[PlannedTrial]) -> None:
        write_json(folder / REQUEST, request)

    return run_trials(trials, folder, begin=begin, **execution)


def plan(
    source: str | Path | Sequence[str | Path],
    *,
    grid: Mapping[str, Sequence[Any]],
    seeds: Iterable[int] = range(20),
    preset: str | None = None,
    settings: Sequence[str] = (),
    loop: bool = False,
    passes: int | None = None,
    inputs: InputOptions | None = None,
    about: Callable[[FrameSource], None] = lambda logs: None,
    **limits: int | None,
) -> list[PlannedTrial]:
    """Check all settings, and return every trial of a sweep in the order of the grid.

    Args:
        source: name of a scene or paths of logs, as for `learn`.
        grid: values to try, by configuration key; every combination is a point.
        seeds: seeds with which every point is tried.
        preset: preset to use instead of that of the source.
        settings: `section.key=value` words for all trials.
        loop: True to start a log again at its end.
        passes: see `arrange_frames`.
        inputs: how images of logs become frames; see `open_source`.
        about: called with the opened logs.
        limits: `max_iterations` and `max_modules`, at which each trial ends.

    Raises:
        UsageError: a key is unknown, a value does not fit, or the source does not exist.
    """
    if keys := [key for key in grid if key.startswith("input.")]:
        raise UsageError(f"grid: {keys[0]} must be equal for all trials: set it with --set")
    words = (source,) if isinstance(source, str | Path) else tuple(source)
    scene, recorded = is_scene(words), None
    # Workers may have another working directory.
    paths = tuple(str(w) if scene or "://" in str(w) else str(Path(w).resolve()) for w in words)
    if not scene:
        inputs = read_inputs(inputs, Layers.read(preset, settings))
        with contextlib.closing(open_logs(words, loop=loop, inputs=inputs)) as logs:
            recorded, spec = dict(logs.describe()), logs.spec
            about(logs)
    inputs = inputs or InputOptions()
    opening = {"loop": loop, "inputs": inputs}
    seeds, ends = tuple(seeds), [*map(limits.get, ("max_iterations", "max_modules")), passes]
    trials: dict[str, PlannedTrial] = {}
    for values in itertools.product(*grid.values()):
        point = dict(zip(grid, values, strict=True))
        points = (f"{key}={value}" for key, value in point.items())
        layers = Layers.read(preset, (*settings, *points))
        if recorded is None:
            configured = configure(str(words[0]), layers, None, inputs)
        else:
            configured = configure_for(spec, recorded, layers, None, inputs)
        learner = configured.learner
        for seed in seeds:
            configuration = configured.seeded(seed)
            depends: list[Any] = [section_table(learner), _user_code(learner.algorithm)]
            if scene:  # the world of a recording does not change the trial
                depends.append(configuration.tables())
            if inputs != InputOptions():
                depends.append(dataclasses.asdict(inputs))
            ends_at = {**limits, "passes": passes}
            call = partial(compute_trial, paths, configuration, opening, seed=seed, **ends_at)
            trial = make_trial(call, depends, seed, recorded, ends, point=point, seed=seed)
            trials.setdefault(trial.id, trial)
    return list(trials.values())


def _user_code(algorithm: str) -> str:
    """Return a hash of the file that defines a user's learner; "" for the package's learners."""
    if algorithm in LEARNERS:
        return ""
    module = inspect.getfile(learner_class(algorithm))
    return hashlib.sha256(Path(module).read_bytes()).hexdigest()


def compute_trial(
    source: Sequence[str],
    configuration: Configuration,
    opening: Mapping[str, Any],
    *,
    seed: int,
    passes: int | None = None,
    **limits: Any,
) -> dict[str, Any]:
    """Run one trial: on oscillatory streams entirely in C if possible, else like `learn`.

    Args:
        source: name of a scene, or paths of logs.
        configuration: the configuration with the point of the grid and the seed.
        opening: `loop` and `inputs` of `open_logs`.
        seed: seed of the trial.
        passes: see `arrange_frames`.
        limits: `max_iterations` and `max_modules`.

    Returns:
        The result as JSON values.
    """
    live = is_scene(source)
    opened = configuration.open_scene() if live else open_logs(source, **opening)
    with contextlib.closing(opened):
        if source == ("oscillatory",) and has_whole_trials(configuration.learner):
            streams = cast(OscillatoryConfig, configuration.scene).streams
            result = run_oscillatory_trial(configuration.learner, streams, seed=seed, **limits)
            modules = with_recipes(result.modules, opened, opened.describe())
            return {
                "iterations": result.iterations,
                "frames": result.frames,
                "modules": [module_table(module) for module in modules],
                "final_policy": list(result.final_policy),
                "epsilon": result.epsilon,
                "ended": result.ended,
            }
        arrange_frames(opened, configuration, passes)
        options: dict[str, Any] = {"seed": seed, "sections": configuration.tables()}
        learned = run_session(opened, configuration.learner, rerun=False, **options, **limits)
    return {key: value for key, value in learned.as_json().items() if key not in DROPPED_KEYS}
