"""What the trials in a folder came to: means with intervals, learning curves, failures."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from cdmisfa.arena.arena import plan
from cdmisfa.arena.contestants import CONTESTANTS
from cdmisfa.arena.sets import SETS
from cdmisfa.core.errors import UsageError
from cdmisfa.experiments.documents import plain, versions, write_json
from cdmisfa.experiments.statistics import mean_interval, summary, wilson
from cdmisfa.experiments.store import DONE, read_rows

RESULTS: Final = "results.json"

FIRST, POINTS = 400, 60
"""First frame of a learning curve, and how many points it has, evenly on a logarithmic scale."""

Row = Mapping[str, Any]

Point = tuple[tuple[str, str], ...]
"""What a trial is of, as `ArenaTrial.point` has it."""


def results(folder: Path) -> dict[str, Any]:
    """What every learner came to on every set, of all trials in a folder.

    Where a trial was computed by several versions of code, set or learner, that of now counts, or
    else the last; how many are not of now is said.

    Raises:
        UsageError: there are no trials.
        LogDamagedError: a row is damaged.
    """
    found: dict[Point, dict[int, list[Row]]] = {}
    for row in read_rows(folder):
        point = tuple(row["point"].items())
        found.setdefault(point, {}).setdefault(row["seed"], []).append(row)
    if not found:
        raise UsageError(f"{folder} holds no trials: run cdmisfa arena -o {folder} first")
    entries, outdated = [], 0
    for point, of_seeds in sorted(found.items(), key=_place):
        names = _names_now(dict(point), of_seeds)
        rows = [
            next((row for row in of_seeds[seed] if row["id"] in names), of_seeds[seed][-1])
            for seed in sorted(of_seeds)
        ]
        entries.append(_entry(dict(point), rows))
        outdated += sum(row["id"] not in names for row in rows)
    return {
        "schema": 1,
        "entries": entries,
        "outdated": outdated,
        "versions": {**versions(), **_versions_of_streams()},
    }


def write_results(folder: Path) -> dict[str, Any]:
    """The results of a folder, also as its results.json."""
    document: dict[str, Any] = plain(results(folder))
    write_json(folder / RESULTS, document)
    return document


def _names_now(point: Mapping[str, str], seeds: Iterable[int]) -> set[str]:
    """What the trials of a point would be called if they were planned now."""
    more = dict(point)
    name, learner, frames = more.pop("set"), more.pop("learner"), more.pop("frames", None)
    limit = None if frames is None else int(frames)
    settings = [f"{key}={value}" for key, value in more.items()]
    try:
        return {t.id for t in plan([name], [learner], seeds, settings, limit, Path())}
    except UsageError:  # a set, learner or key of an earlier version
        return set()


def _place(item: tuple[Point, Any]) -> tuple[int, str, tuple[Any, ...]]:
    """Where a point stands in a table: by set, by what else was set, by learner."""
    point = dict(item[0])
    name, learner = point.pop("set"), point.pop("learner")
    orders = (list(SETS), list(CONTESTANTS))
    at, by = (
        order.index(key) if key in order else len(order)
        for order, key in zip(orders, (name, learner), strict=True)
    )
    return at, name, (tuple(point.items()), by, learner)


def _entry(point: Mapping[str, str], rows: Sequence[Row]) -> dict[str, Any]:
    found = [row["result"] for row in rows if row["status"] == DONE]
    return {
        "point": dict(point),
        "seeds": [row["seed"] for row in rows],
        "failed": [row["error"] for row in rows if row["status"] != DONE],
        "measures": _measures(found),
        "targets": _targets(found),
        "wrong": _wrong(found),
        "probes": _probes(found),
        "curve": _curve(found),
    }


def _measures(found: Sequence[Row]) -> dict[str, Any]:
    """Mean, 95 % interval and number of trials of every measure."""
    ends = [bool(row["ended"]) for row in found if row["ended"] is not None]
    return {
        "learned": _measure([_share(row, math.inf) for row in found]),
        "modules": _measure([len(row["modules"]) for row in found]),
        "wrong": _measure([row["wrong"] for row in found]),
        "doubles": _measure([row["doubles"] for row in found]),
        "ended": _measure(ends) | _bounds(wilson(sum(ends), len(ends))),
        "blocks": _measure([row["blocks"] for row in found if row["ended"]]),
        "blocks_learned": _measure([b for row in found if (b := _last_block(row)) is not None]),
        "probe": _measure([_probe(row, "modules") for row in found]),
        "probe_components": _measure([_probe(row, "components") for row in found]),
    }


def _measure(values: ArrayLike) -> dict[str, Any]:
    found = summary(values)
    return asdict(found) | _bounds(mean_interval(values))


def _bounds(interval: tuple[float, float]) -> dict[str, float]:
    return dict(zip(("low", "high"), interval, strict=True))


def _share(row: Row, frame: float) -> float:
    """Share of what can be learned that was learned by a frame."""
    frames = [t["frame"] for t in row["targets"]]
    return float(np.mean([f is not None and f <= frame for f in frames]))


def _last_block(row: Row) -> int | None:
    """The block by which everything was learned."""
    blocks = [t["block"] for t in row["targets"]]
    return None if None in blocks else max(blocks)


def _probe(row: Row, key: str) -> float:
    values = [p[key] for p in row["probes"] if p[key] is not None]
    return float(np.mean(values)) if values else math.nan


def _targets(found: Sequence[Row]) -> list[dict[str, Any]]:
    """Of everything that can be learned, with how many seeds it was, and how soon."""
    tables = []
    for same in zip(*(row["targets"] for row in found), strict=True):
        learned = [t for t in same if t["frame"] is not None]
        tables.append(
            {
                "stream": same[0]["stream"],
                "signal": same[0]["signal"],
                "learned": len(learned),
                "trials": len(same),
                "block": _measure([t["block"] for t in learned]),
                "watched": _measure([t["watched"] for t in learned]),
            }
        )
    return tables


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


def _wrong(found: Sequence[Row]) -> dict[str, int]:
    """How many modules came of each signal that has nothing to be learned, over all trials."""
    signals = [m["signal"] for row in found for m in row["modules"] if not m["learnable"]]
    return {name: signals.count(name) for name in sorted(set(signals))}


def _curve(found: Sequence[Row]) -> dict[str, list[float]]:
    """Share learned by frames seen: mean and standard deviation over trials."""
    if not found:
        return {"frames": [], "mean": [], "sd": []}
    last = max(FIRST + 1, *(row["frames"] for row in found))
    frames = np.geomspace(FIRST, last, POINTS)
    shares = np.array([[_share(row, frame) for frame in frames] for row in found])
    return {
        "frames": frames.round().tolist(),
        "mean": shares.mean(axis=0).tolist(),
        "sd": shares.std(axis=0).tolist(),
    }


def _versions_of_streams() -> dict[str, str]:
    from importlib import metadata

    found = {}
    for name in ("gymnasium", "ale-py", "scikit-video"):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found
