"""The arena: plan trials, make their streams, run what is missing.

DIR/rows.jsonl has a row for every finished trial, DIR/streams what they learned from; what all
of them came to is in `results`. Beside the progress learner and the paper's own there is the
progress learner with every other rule for choosing the stream to watch.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from importlib import metadata
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from cdmisfa.agents.progress.config import ATTENTIONS
from cdmisfa.core.config import section_table
from cdmisfa.core.errors import CdmisfaError, UsageError
from cdmisfa.core.processes import WorkerDied, run_all
from cdmisfa.core.registry import Registry
from cdmisfa.experiments.documents import plain, versions, write_json
from cdmisfa.experiments.results import mean_interval, summary, wilson
from cdmisfa.experiments.sources import configure
from cdmisfa.experiments.store import (
    DONE,
    SweepReport,
    answer,
    code,
    read_rows,
    run_trials,
    trial_id,
)
from cdmisfa.studies.arena.library import Library
from cdmisfa.studies.arena.pictures import PARTS
from cdmisfa.studies.arena.streams import SETS, parse
from cdmisfa.studies.arena.trial import ArenaTrial, run_arena_trial

CONTESTANTS: Registry[tuple[str, ...]] = Registry(
    "learner of the arena",
    {
        "progress": ("learner.algorithm=progress",),
        "2.0": ("learner.algorithm=2.0",),
        "1.0": ("learner.algorithm=1.0",),
        "learning-progress": ("learner.algorithm=progress", "learner.attention=progress"),
        **{
            name: ("learner.algorithm=progress", f"learner.attention={name}")
            for name in ATTENTIONS
            if name not in ("progress", "novel")  # novel is the default
        },
    },
)
"""Settings of every learner that is compared, over its preset."""

COMPUTED: Final = tuple(
    f"cdmisfa/studies/arena/{name}"
    for name in ("cameras", "elsewhere", "library", "pictures", "streams", "trial")
)
"""Modules that decide what a trial comes to."""

Progress = Callable[[int, int, str], None]
"""Told how many are done, of how many, and what else is to be said."""


def run_arena(
    folder: Path,
    sets: Sequence[str],
    learners: Sequence[str] = (),
    seeds: Iterable[int] = range(10),
    *,
    settings: Sequence[str] = (),
    budget: int | None = None,
    switch_cost: int = 0,
    streams: Path | None = None,
    retry_failed: bool = False,
    making: Progress = lambda done, total, note: None,
    progress: Progress = lambda done, total, note: None,
    **where: Any,
) -> SweepReport:
    """Run every learner on every set with every seed, where that was not done yet.

    Args:
        folder: of the results.
        sets: names in `SETS`.
        learners: names in `CONTESTANTS`; by default all.
        seeds: of learners and streams, both.
        settings: `section.key=value` words for all learners.
        budget: frames after which a run is stopped, instead of those of its set.
        switch_cost: frames that are lost at each change of view.
        streams: folder of the streams, by default in that of the results.
        retry_failed: compute trials again that failed before.
        making: told of streams that are made.
        progress: told of trials.
        where: to compute: jobs, engine and scheduler, see `run_all`.

    Raises:
        UsageError: a wrong name, key or value, or a stream needs a package that is missing.
        EngineError: no scheduler answers.
    """
    library = Path(streams or folder / "streams").resolve()
    each = learners or tuple(CONTESTANTS)
    trials = plan_arena(
        sets, each, seeds, settings, library, budget=budget, switch_cost=switch_cost
    )
    return run_trials(
        trials,
        Path(folder).resolve(),
        compute_arena_trial,
        **where,
        retry_failed=retry_failed,
        begin=lambda missing: _make_streams(missing, where, making),
        progress=lambda done, failed, total: progress(
            done, total, f"{failed} failed" if failed else ""
        ),
    )


def plan_arena(
    sets: Sequence[str],
    learners: Sequence[str],
    seeds: Iterable[int],
    settings: Sequence[str],
    library: Path,
    *,
    budget: int | None = None,
    switch_cost: int = 0,
) -> list[ArenaTrial]:
    """Every trial, seeds innermost; see `run_arena`.

    Raises:
        UsageError: a wrong name, key or value.
    """
    version, each = code(*COMPUTED), tuple(dict.fromkeys(seeds))
    more = dict(word.split("=", 1) for word in settings if "=" in word)
    more |= {k: str(n) for k, n in (("budget", budget), ("switch cost", switch_cost)) if n}
    trials = []
    for name in dict.fromkeys(sets):
        entry = SETS[name]
        if budget:
            entry = replace(entry, frames=budget)
        if switch_cost:
            entry = replace(entry, switch_cost=switch_cost)
        shown = {key: value for key, value in asdict(entry).items() if key != "about"}
        preset = "icub" if entry.images else "oscillatory"
        for learner in dict.fromkeys(learners):
            config = configure(preset, settings=(*CONTESTANTS[learner], *settings)).learner
            point = {"set": name, "learner": learner, **more}
            for seed in each:
                trial = ArenaTrial(
                    id=trial_id(shown, section_table(config), seed, version),
                    point=point,
                    seed=seed,
                    code=version,
                    streams=entry,
                    learner=config,
                    library=library,
                )
                trials.append(trial)
    return trials


def compute_arena_trial(trial: ArenaTrial) -> Mapping[str, Any]:
    """Compute one trial: its row, or under "error" why there is none."""
    return answer(trial, code(*COMPUTED), lambda it: plain(run_arena_trial(it)))


Task = tuple[Path, list[tuple[str, int, int, str]]]
"""Folder of the streams, and what to prepare there, one after the other; see `Library`."""


def _make_streams(trials: Sequence[ArenaTrial], where: Mapping[str, Any], making: Progress) -> None:
    """Make the streams that are missing; in one process what is seen of one through cameras."""
    tasks: dict[tuple[str, int], Task] = {}
    for trial in trials:
        for showing in {s for word in trial.streams.words for s in parse(word)}:
            wanted = showing.name, trial.seed, *trial.reference
            _, group = tasks.setdefault((showing.kind, trial.seed), (trial.library, []))
            if wanted not in group and not Library(trial.library).has(*wanted):
                group.append(wanted)
    missing = [(folder, sorted(group)) for folder, group in tasks.values() if group]
    for done, (_, result) in enumerate(run_all(make_streams, missing, **where), 1):
        if isinstance(result, WorkerDied):
            raise CdmisfaError(f"a stream could not be made: {result.what}")
        making(done, len(missing), "")


def make_streams(task: Task) -> None:
    """Make streams, for any process to call."""
    folder, wanted = task
    for each in wanted:
        Library(folder).prepare(*each)


FIRST, POINTS = 400, 60
"""First frame of a learning curve, and how many points it has, evenly on a logarithmic scale."""

Row = Mapping[str, Any]


def arena_results(folder: Path) -> dict[str, Any]:
    """What every learner came to on every set, of all trials in a folder; also its results.json.

    Where a trial was computed by several versions of the code, that of now counts, or else the
    last; how many are not of now is said.

    Raises:
        UsageError: there are no trials.
        LogDamagedError: a row is damaged.
    """
    now = code(*COMPUTED)
    found: dict[tuple[tuple[str, str], ...], dict[int, Row]] = {}
    for row in read_rows(folder):
        of_seeds = found.setdefault(tuple(row["point"].items()), {})
        if row["code"] == now or of_seeds.get(row["seed"], {}).get("code") != now:
            of_seeds[row["seed"]] = row
    if not found:
        raise UsageError(f"{folder} holds no trials: run cdmisfa arena -o {folder} first")
    entries = [
        _entry(dict(point), [of_seeds[seed] for seed in sorted(of_seeds)])
        for point, of_seeds in found.items()
    ]
    outdated = sum(row["code"] != now for of_seeds in found.values() for row in of_seeds.values())
    used = {**versions(), **_versions_of_streams()}
    entries.sort(key=lambda entry: _place(**entry["point"]))
    document: dict[str, Any] = plain(
        {"schema": 1, "entries": entries, "outdated": outdated, "versions": used}
    )
    write_json(
        folder / "results.json", json.dumps(document) + "\n"
    )  # half as large as with line ends
    return document


def _place(set: str, learner: str, **more: str) -> tuple[Any, ...]:
    """Where a point stands in a table: by set, by what else was set, by learner."""
    sets, learners = list(SETS), list(CONTESTANTS)
    at = sets.index(set) if set in sets else len(sets)
    by = learners.index(learner) if learner in learners else len(learners)
    return at, set, tuple(more.items()), by, learner


def _entry(point: Mapping[str, str], rows: Sequence[Row]) -> dict[str, Any]:
    found = [row["result"] for row in rows if row["status"] == DONE]
    wrong = [m["signal"] for row in found for m in row["modules"] if not m["learnable"]]
    return {
        "point": point,
        "seeds": [row["seed"] for row in rows],
        "failed": [row["error"] for row in rows if row["status"] != DONE],
        "measures": _measures(found),
        "targets": _targets(found),
        "wrong": {name: wrong.count(name) for name in sorted({*wrong})},
        "modules": [_judged(m) for row in found for m in row["modules"] if m["learnable"]],
        "told": _told(found),
        "probes": _probes(found),
        "curve": _curve(found),
    }


MEASURES: Final[Mapping[str, Callable[[Row], float | None]]] = {
    "learned": lambda row: _share(row, math.inf),
    "fitted": lambda row: float(np.mean([t["fitted"] for t in row["targets"]])),
    "modules": lambda row: len(row["modules"]),
    "wrong": lambda row: row["wrong"],
    "doubles": lambda row: row["doubles"],
    "one": lambda row: _mean(row["pairs"]["one"]),
    "merged": lambda row: _mean(row["pairs"]["others"]),
    "in_vain": lambda row: row["in_vain"],
    "told": lambda row: max(row["told"].values(), default=None),
    "ended": lambda row: None if row["ended"] is None else bool(row["ended"]),
    "blocks": lambda row: row["blocks"] if row["ended"] else None,
    "blocks_learned": lambda row: _last(row, "block"),
    "frames_learned": lambda row: _last(row, "frame"),
    "probe": lambda row: _probe(row, "modules"),
    "probe_components": lambda row: _probe(row, "components"),
}
"""What a trial came to, None where that says nothing; see `page.DEFINITIONS`."""


def _measures(found: Sequence[Row]) -> dict[str, Any]:
    values = {name: [measure(row) for row in found] for name, measure in MEASURES.items()}
    measures = {name: _measure([v for v in of if v is not None]) for name, of in values.items()}
    ends = [ended for ended in values["ended"] if ended is not None]
    return measures | {"ended": _measure(ends, wilson(int(sum(ends)), len(ends)))}


def _measure(values: ArrayLike, interval: tuple[float, float] | None = None) -> dict[str, Any]:
    """Mean, SD, number of trials and 95 % interval."""
    low, high = interval or mean_interval(values)
    return {**asdict(summary(values)), "low": low, "high": high}


def _share(row: Row, frame: float) -> float:
    """Share of what can be learned that was learned by a frame."""
    frames = [t["frame"] for t in row["targets"]]
    return float(np.mean([f is not None and f <= frame for f in frames]))


def _last(row: Row, key: str) -> int | None:
    """The block, or the frame, by which everything was learned."""
    at = [t[key] for t in row["targets"]]
    return None if None in at else max(at)


def _probe(row: Row, key: str) -> float | None:
    return _mean([p[key] for p in row["probes"] if p[key] is not None])


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _targets(found: Sequence[Row]) -> list[dict[str, Any]]:
    """Of everything that can be learned, with how many seeds it was, and how soon.

    Where it was not there may be modules of it: "too_fast" is with how many seeds; where it was it
    may have been by a module of something else: "known".
    """
    tables = []
    for same in zip(*(row["targets"] for row in found), strict=True):
        signal = same[0]["signal"]
        learned = [t for t in same if t["frame"] is not None]
        saved = [signal in [m["signal"] for m in row["modules"]] for row in found]
        fast = sum(had and t["frame"] is None for had, t in zip(saved, same, strict=True))
        table = {"stream": same[0]["stream"], "signal": signal, "too_fast": fast}
        table |= {"learned": len(learned), "trials": len(same)}
        table["known"] = sum(t["known"] for t in learned)
        table["watched"] = _measure([t["watched"] for t in learned if t["watched"]])
        tables.append(table | {"block": _measure([t["block"] for t in learned])})
    return tables


def _judged(module: Row) -> dict[str, Any]:
    """Slowness of a module, and that of batch SFA."""
    parts = [key for part in PARTS for key in (part, f"{part}_of_batch")]
    return {key: module[key] for key in ("signal", *parts)}


def _told(found: Sequence[Row]) -> dict[str, list[int]]:
    """Blocks until each stream that cannot be learned was said to be so, of all trials."""
    names = sorted({name for row in found for name in row["told"]})
    return {n: [row["told"][n] for row in found if n in row["told"]] for n in names}


def _probes(found: Sequence[Row]) -> dict[str, Any]:
    """Of each signal that a module was saved of, what the modules tell of the world."""
    told = [probe for row in found for probe in row["probes"] if probe["modules"] is not None]
    return {
        signal: {
            key: _measure([p[key] for p in told if p["signal"] == signal])
            for key in ("outputs", "modules", "components")
        }
        for signal in sorted({p["signal"] for p in told})
    }


def _curve(found: Sequence[Row]) -> dict[str, list[float]]:
    """Share learned by frames seen: mean and standard deviation over trials."""
    if not found:
        return {"frames": [], "mean": [], "sd": []}
    last = max(FIRST + 1, *(row["frames"] for row in found))
    frames = np.geomspace(FIRST, last, POINTS)
    shares = np.array([[_share(row, frame) for frame in frames] for row in found])
    mean, sd = shares.mean(axis=0), shares.std(axis=0)
    return {"frames": frames.round().tolist(), "mean": mean.tolist(), "sd": sd.tolist()}


def _versions_of_streams() -> dict[str, str]:
    found = {}
    for name in ("gymnasium", "ale-py", "scikit-learn", "scikit-video", "matplotlib"):
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found
