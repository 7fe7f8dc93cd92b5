"""Sweeps: many trials over a grid of settings and seeds, each computed once.

A trial is named by a hash of everything it depends on. Finished trials are rows of
DIR/rows.jsonl, one line of JSON each; a sweep that was stopped, or is asked for again
with more seeds or a larger grid, computes what is missing.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, BinaryIO, cast

from cdmisfa.core.config import LearnerConfig, as_table
from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from cdmisfa.experiments.engines import WorkerDied, run_all
from cdmisfa.experiments.manifest import write_json
from cdmisfa.experiments.runs import module_table, run
from cdmisfa.experiments.sources import Configuration, configure, open_source, preset_for
from recorder.log.folder import held
from recorder.world.oscillatory import OscillatoryConfig
from recorder.world.scenes import SCENES, open_scene

ROWS = "rows.jsonl"
"""A line for each trial that ended; the last line of a trial counts."""

REQUEST = "sweep.json"
"""What was asked for last."""

DONE, FAILED = "done", "failed"

UNKEPT = ("schema", "run", "source", "seed", "signals_sha256")
"""What of a run's result a trial's row has elsewhere, or not at all."""


@dataclass(frozen=True, slots=True)
class Trial:
    """One run of a sweep, and everything a worker needs to compute it.

    Attributes:
        id: hash of configuration, seed, source and code.
        source: a scene's name, or the paths of a recording.
        configuration: preset, settings, the grid's point and the seed, all together.
        point: the grid's keys with this trial's values.
        seed: of the learner, and of a live scene.
        loop: start a recording again at its end.
        max_iterations: end after so many.
        max_modules: end after so many.
        log: folder in which to keep its log, or None.
        code: version of the code that the hash is about; workers must have the same.
    """

    id: str
    source: tuple[str, ...]
    configuration: Configuration
    point: Mapping[str, str]
    seed: int
    loop: bool
    max_iterations: int | None
    max_modules: int | None
    log: Path | None
    code: str


@dataclass(frozen=True, slots=True)
class SweepReport:
    """What a sweep came to.

    Attributes:
        folder: of the sweep.
        trials: how many were asked for.
        skipped: how many of them were finished before.
        computed: how many finished now.
        failed: rows of those that failed, now or before.
        outdated: how many of them were finished before by other code, and not reused.
    """

    folder: Path
    trials: int
    skipped: int
    computed: int
    failed: tuple[Mapping[str, Any], ...] = field(default=())
    outdated: int = 0


def sweep(
    source: Sequence[str | Path],
    folder: Path,
    *,
    grid: Mapping[str, Sequence[Any]] | None = None,
    seeds: Iterable[int] = range(20),
    preset: str | None = None,
    settings: Sequence[str] = (),
    loop: bool = False,
    max_iterations: int | None = None,
    max_modules: int | None = None,
    jobs: int = 1,
    engine: str = "local",
    scheduler: str | None = None,
    keep_logs: bool = False,
    retry_failed: bool = False,
    progress: Callable[[int, int, int], None] | None = None,
) -> SweepReport:
    """Run every trial of a grid that is not finished yet.

    Args:
        source: a scene's name or a recording's paths, as for `learn`.
        folder: where the rows are; made where it does not exist.
        grid: values to try, by configuration key; every combination is a point.
        seeds: every point is tried with each of them.
        preset: instead of the source's own.
        settings: `section.key=value` words for all trials.
        loop: start a recording again at its end.
        max_iterations: end each trial after so many.
        max_modules: end each trial after so many.
        jobs: local processes.
        engine: where to compute, see `engines.ENGINES`.
        scheduler: address of a dask scheduler.
        keep_logs: keep each trial's run folder in folder/trials; with workers on other
            machines it must be a shared one.
        retry_failed: compute trials again that failed before.
        progress: called with the trials finished, failed, and asked for.

    Raises:
        UsageError: a wrong key, value, source or engine, found before any trial starts.
        EngineError: no scheduler answers.
    """
    folder = Path(folder).resolve()
    if log := next(folder.glob("*.mcap*"), None):
        raise UsageError(f"{folder} holds {log.name}, of a run or a recording: choose another -o")
    trials = plan(
        source,
        grid=grid or {},
        seeds=seeds,
        preset=preset,
        settings=settings,
        loop=loop,
        max_iterations=max_iterations,
        max_modules=max_modules,
        logs=folder / "trials" if keep_logs else None,
    )
    folder.mkdir(parents=True, exist_ok=True)
    with _rows_file(folder) as file:
        before = {row["id"]: row for row in read_rows(folder)}
        write_json(folder / REQUEST, _request(source, grid or {}, trials))
        open_trials = [t for t in trials if _is_open(t, before.get(t.id), retry_failed)]
        rows = dict(before)
        finished = len(trials) - len(open_trials)
        again = {trial.id for trial in open_trials}
        failed = sum(_has_failed(rows.get(t.id)) for t in trials if t.id not in again)
        for index, result in run_all(
            run_trial, open_trials, jobs=jobs, engine=engine, scheduler=scheduler
        ):
            trial = open_trials[index]
            row = _row(trial, result)
            _append(file, row)
            rows[trial.id] = row
            finished += 1
            failed += _has_failed(row)
            if progress is not None:
                progress(finished, failed, len(trials))
    mine = [rows[trial.id] for trial in trials]
    return SweepReport(
        folder=folder,
        trials=len(trials),
        skipped=len(trials) - len(open_trials),
        computed=sum(rows[t.id]["status"] == DONE for t in open_trials),
        failed=tuple(row for row in mine if _has_failed(row)),
        outdated=_outdated(open_trials, before.values()),
    )


def plan(
    source: Sequence[str | Path],
    *,
    grid: Mapping[str, Sequence[Any]],
    seeds: Iterable[int],
    preset: str | None = None,
    settings: Sequence[str] = (),
    loop: bool = False,
    max_iterations: int | None = None,
    max_modules: int | None = None,
    logs: Path | None = None,
) -> list[Trial]:
    """Every trial of a sweep, in the grid's order, seeds innermost; checks all settings.

    Raises:
        UsageError: an unknown key, a value that does not fit, or no such source.
    """
    words = (source,) if isinstance(source, str | Path) else tuple(source)
    kind, identity = _identify(words, preset, loop)
    points = [
        dict(zip(grid, map(str, values), strict=True))
        for values in itertools.product(*grid.values())
    ]
    # Workers may have another working directory.
    paths = tuple(str(w) if w == kind or "://" in str(w) else str(Path(w).resolve()) for w in words)
    each = tuple(dict.fromkeys(seeds))
    limits = [max_iterations, max_modules]
    trials: dict[str, Trial] = {}
    for point in points:
        chosen = (*settings, *(f"{key}={value}" for key, value in point.items()))
        seeded = _seeded(kind, preset, chosen)
        for seed in each:
            configuration = seeded(seed)
            depends = [_configuration(configuration, identity), seed, identity, limits, code()]
            trial = Trial(
                id=_hash(depends),
                source=paths,
                configuration=configuration,
                point=point,
                seed=seed,
                loop=loop,
                max_iterations=max_iterations,
                max_modules=max_modules,
                log=logs / _hash(depends) if logs is not None else None,
                code=code(),
            )
            trials.setdefault(trial.id, trial)
    return list(trials.values())


def _seeded(
    kind: str, preset: str | None, settings: Sequence[str]
) -> Callable[[int], Configuration]:
    """`configure` for many seeds at once: a seed only ever becomes `scene.seed`."""
    base, other = (configure(kind, preset, settings, seed) for seed in (0, 1))
    if base == other:
        return lambda seed: base
    return lambda seed: replace(base, scene=replace(base.scene, seed=seed))


def _identify(words: tuple[str | Path, ...], preset: str | None, loop: bool) -> tuple[str, Any]:
    """The scene's name, and what tells a recording's bytes from another's (None where live)."""
    if _is_live(words):
        return str(words[0]), None
    source, _ = open_source(words, loop=loop)
    try:
        described = dict(source.describe())
        return preset_for(source.spec, described, preset), described
    finally:
        source.close()


def _is_live(words: Sequence[str | Path]) -> bool:
    return len(words) == 1 and words[0] in SCENES


def _configuration(configuration: Configuration, identity: Any) -> Any:
    """What of a configuration a trial depends on: the world's part only where it is live."""
    learner = as_table(configuration.learner)
    return [learner] if identity is not None else [learner, configuration.tables()]


def _hash(value: Any) -> str:
    text = json.dumps(value, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:32]


@cache
def code() -> str:
    """Version of what a trial computes: the package's, and a hash of learner and recorder."""
    root = Path(__file__).parents[2]
    rooms = ("cdmisfa/core", "cdmisfa/features", "cdmisfa/agents", "recorder")
    files = [file for room in rooms for file in (root / room).rglob("*.py")]
    digest = hashlib.sha256()
    for file in sorted([*files, root / "cdmisfa/experiments/trial.py"]):
        digest.update(f"{file.relative_to(root).as_posix()}\0".encode() + file.read_bytes())
    return f"{metadata.version('cdmisfa')}+{digest.hexdigest()[:12]}"


def run_trial(trial: Trial) -> dict[str, Any]:
    """Compute one trial.

    Oscillatory trials without a log run in compiled code as a whole; all others run as
    `learn` does.

    Returns:
        The result, or under "error" why there is none.
    """
    if trial.code != code():
        return {"error": f"the worker has cdmisfa {code()}, not {trial.code}: install the same"}
    try:
        known = isinstance(trial.configuration.learner, LearnerConfig)
        if trial.source == ("oscillatory",) and trial.log is None and known:
            return _compiled_trial(trial)
        return _logged_trial(trial)
    except CdmisfaError as error:
        return {"error": str(error)}
    except Exception as error:
        # Whatever breaks in one trial must not end a sweep of thousands.
        return {"error": f"{type(error).__name__}: {error}"}


def _compiled_trial(trial: Trial) -> dict[str, Any]:
    from cdmisfa.experiments.trial import run_trial as run_oscillatory

    streams = cast(OscillatoryConfig, trial.configuration.scene).streams
    result = run_oscillatory(
        trial.configuration.learner,
        streams,
        seed=trial.seed,
        max_iterations=trial.max_iterations,
        max_modules=trial.max_modules,
    )
    return {
        "iterations": result.iterations,
        "frames": result.frames,
        "modules": [module_table(module, streams) for module in result.modules],
        "final_policy": list(result.final_policy),
        "epsilon": result.epsilon,
        "ended": result.ended,
    }


def _logged_trial(trial: Trial) -> dict[str, Any]:
    configuration = trial.configuration
    if _is_live(trial.source):
        source = open_scene(trial.source[0], configuration.scene, configuration.record)
    else:
        source, _ = open_source(trial.source, loop=trial.loop)
    unfinished = None
    if trial.log is not None:
        unfinished = trial.log.with_name(trial.log.name + ".partial")
        unfinished.parent.mkdir(parents=True, exist_ok=True)
    try:
        result = run(
            source,
            configuration.learner,
            unfinished,
            seed=trial.seed,
            max_iterations=trial.max_iterations,
            max_modules=trial.max_modules,
            sections=configuration.tables(),
            force=True,
            rerun=False,
        )
    finally:
        source.close()
    if unfinished is not None and trial.log is not None:
        shutil.rmtree(trial.log, ignore_errors=True)
        os.replace(unfinished, trial.log)
    told = result.as_json()
    return {key: value for key, value in told.items() if key not in UNKEPT}


def _row(trial: Trial, result: Mapping[str, Any] | WorkerDied) -> dict[str, Any]:
    if isinstance(result, WorkerDied):
        result = {"error": result.what}
    failed = "error" in result
    return {
        "id": trial.id,
        "status": FAILED if failed else DONE,
        "point": dict(trial.point),
        "seed": trial.seed,
        "code": trial.code,
        "run": str(trial.log) if trial.log is not None and not failed else None,
        **({"error": result["error"]} if failed else {"result": result}),
    }


def _outdated(trials: Sequence[Trial], rows: Iterable[Mapping[str, Any]]) -> int:
    """How many trials are in the rows already, but computed by other code."""
    done = {
        (json.dumps(row["point"], sort_keys=True), row["seed"])
        for row in rows
        if row["status"] == DONE and row.get("code") != code()
    }
    return sum((json.dumps(dict(t.point), sort_keys=True), t.seed) in done for t in trials)


def _has_failed(row: Mapping[str, Any] | None) -> bool:
    return row is not None and row["status"] == FAILED


def _is_open(trial: Trial, row: Mapping[str, Any] | None, retry_failed: bool) -> bool:
    if row is None or (retry_failed and row["status"] == FAILED):
        return True
    return row["status"] == DONE and trial.log is not None and not trial.log.is_dir()


def _request(
    source: Sequence[str | Path], grid: Mapping[str, Sequence[Any]], trials: Sequence[Trial]
) -> dict[str, Any]:
    return {
        "schema": 1,
        "source": [str(word) for word in trials[0].source] if trials else [],
        "grid": {key: [str(value) for value in values] for key, values in grid.items()},
        "seeds": sorted({trial.seed for trial in trials}),
        "code": code(),
        "trials": [{"id": trial.id, "point": dict(trial.point)} for trial in trials],
    }


def read_rows(folder: Path) -> Iterator[dict[str, Any]]:
    """The last row of every trial in a sweep's folder, in the order of their first rows.

    A last line that a kill cut short does not count.

    Raises:
        LogDamagedError: a line is not a row.
    """
    path = folder / ROWS
    rows: dict[str, dict[str, Any]] = {}
    data = path.read_bytes() if path.is_file() else b""
    for number, line in enumerate(data[: data.rfind(b"\n") + 1].splitlines(), start=1):
        try:
            row = json.loads(line)
            rows[row["id"]] = {**row, "status": row["status"], "point": dict(row["point"])}
        except (ValueError, KeyError, TypeError) as error:
            raise LogDamagedError(
                f"{path} line {number} is no trial's row: remove the line"
            ) from error
    yield from rows.values()


@contextlib.contextmanager
def _rows_file(folder: Path) -> Iterator[BinaryIO]:
    """The rows, to append to; held by one sweep at a time, a torn last line cut off."""
    path = folder / ROWS
    with held(folder), open(path, "a+b") as file:
        file.seek(0)
        file.truncate(file.read().rfind(b"\n") + 1)
        yield file


def _append(file: BinaryIO, row: Mapping[str, Any]) -> None:
    file.write(json.dumps(row, separators=(",", ":")).encode() + b"\n")
    file.flush()
