"""What can be read from features: R2 of the true state, for modules and for other features.

Each stream is learned alone, from the first three quarters of its frames. The modules' novelty is
measured too: on the log that they were learned from, and on frames of other scenes.
"""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import cdmisfa
from benchmarks.arena.judging import probe
from benchmarks.arena.pictures import Footage
from benchmarks.arena.streams import REPORTED, SETS, linear, make_footage, parse
from benchmarks.report import save
from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.blocks import PIXEL
from cdmisfa.experiments.apply import Application
from cdmisfa.features.recursive import RecursiveFeature
from cdmisfa.modules import Module

SEEDS = (40, 41)
"""No decision used these seeds, nor the streams of the sets whose name begins with "reported-"."""

LABELS = (None, 200, 50)
"""Frames with a known state to fit the probe: all that the features were learned from, or some."""

COMPONENTS = (8, 16, 32, 64)

SETTINGS: dict[str, dict[str, int]] = {
    "8 slow of 16": {"principal": 0, "wide": 0},
    "module": {},
}
"""Settings of the learner for the modules that are compared."""

DRAWS = 10_000
"""Resampled sets of streams for an interval."""

OTHERS = 3
"""Other scenes whose frames are compared with those of a stream."""

NOTE = (
    "R2 of the true state on the last quarter of the frames, by ridge regression from features of "
    "one frame; a part of the state that is predicted worse than by its mean counts 0. Features "
    "are learned from the first three quarters without labels; the probe is fitted on all of these "
    "frames, or on 200 or 50 of them, spread evenly. `8 slow of 16`: a module of 8 slow features "
    "of 16 components; `module`: one of 8 slow features and 8 principal components. Modules stop "
    "learning when the stream is decided; the other features use all frames to learn from. Each "
    f"row is the mean over the seeds {SEEDS[0]} and {SEEDS[1]}; the first table has the means of "
    "the rows and their 95 % intervals over streams (bootstrap). No decision used these "
    "streams or seeds. "
    "A stream without a module counts 0. Known: share of the blocks of the training frames on "
    "which `apply` gives a novelty of at most 1. AUROC: probability that novelty is higher in a "
    "block of another scene than in a block of the stream's own last quarter."
)


def streams() -> list[str]:
    """Return the names of the learnable streams of images with a known state."""
    words = [word for name in REPORTED for word in SETS[name]["words"]]
    shown = [showing for word in words for showing in parse(word) if showing.learnable]
    return sorted({showing.name for showing in shown})


def learn(footage: Footage, folder: Path, **settings: int) -> Module | None:
    """Return the module that is learned from the frames to learn from; None without a module."""
    how: dict[str, Any] = {"algorithm": "progress", "holdout": 0, "max_modules": 1, "force": True}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about the rate of arrays, and rejected streams
        run = cdmisfa.learn([_written(footage.training, folder)], folder / "run", **how, **settings)
    return run.modules[0] if run.modules else None


def _written(frames: Any, folder: Path) -> str:
    np.save(folder / "frames.npy", frames)
    return str(folder / "frames.npy")


def reference(frames: Any) -> dict[str, Module]:
    """Return the other features: principal components, and batch SFA of 32 of them."""
    rows = frames.reshape(len(frames), -1)
    sfa = RecursiveFeature(rows.shape[1], max(COMPONENTS), window=len(rows))
    sfa.update(rows)
    slow = RecursiveFeature(rows.shape[1], 32, 16, window=len(rows))
    slow.update(rows)
    scale = np.sqrt(sfa.state.variance)[:, None]
    features = {f"{n} PC": linear(sfa.state.basis[:n] / scale[:n], sfa.mean, "none", PIXEL)
                for n in COMPONENTS}  # fmt: skip
    return features | {"SFA, 16 of 32": linear(slow.phi, slow.mean, "none", PIXEL)}


def novelty(folder: Path, frames: Any) -> FloatArray:
    """Return the novelty of the run's module in each block of some frames, by `apply`."""
    application = Application(folder / "run")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        source = application.open([_written(frames, folder)])
        values = [float(applied.novelty[0]) for applied in application.to(source)]
        source.close()
    return np.array(values)


def auroc(low: FloatArray, high: FloatArray) -> float:
    """Return the probability that a value of `high` is above one of `low`; ties count half."""
    more = (high[:, None] > low).mean() + 0.5 * (high[:, None] == low).mean()
    return float(more)


def measure(footage: Footage, others: Sequence[Footage]) -> dict[str, list[float]]:
    """Return R2 of each kind of features by number of labels, and `known` and `AUROC`."""
    results: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for kind, settings in SETTINGS.items():
            module = learn(footage, folder, **settings)
            results[kind] = _scores(module, footage)
        for kind, features in reference(footage.training).items():
            results[kind] = _scores(features, footage)
        known = auc = np.nan
        if module is not None:
            known = float((novelty(folder, footage.training) <= 1).mean())
            own = novelty(folder, footage.following)
            new = [novelty(folder, other.following) for other in others]
            auc = auroc(own, np.concatenate(new))
    return results | {"known": [known], "AUROC": [auc]}


def _scores(features: Module | None, footage: Footage) -> list[float]:
    if features is None:
        return [0.0] * len(LABELS)
    y = features.transform(footage.frames)
    return [probe(y, footage.state, labels) for labels in LABELS]


def interval(values: FloatArray) -> str:
    """Return the 95 % interval of the mean over streams, by bootstrap."""
    rng = np.random.default_rng(0)
    means = rng.choice(values, (DRAWS, len(values))).mean(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return f"[{low:.2f}, {high:.2f}]"


def interval_text(values: FloatArray) -> str:
    """Return the mean of the values that are known, and its interval."""
    known = values[np.isfinite(values)]
    return f"{known.mean():.3f} {interval(known)}"


def tables_of(names: Sequence[str], kinds: Sequence[str], R2: FloatArray, novelty: FloatArray
              ) -> list[Any]:  # fmt: skip
    """Return the tables: means, then a row for each stream.

    Args:
        names: the streams.
        kinds: the features.
        R2: (streams, kinds, labels).
        novelty: (streams, 2) share known, and AUROC.
    """
    R2, novelty = R2.round(3), novelty.round(3)
    module, means, parts = kinds.index("module"), list[list[str]](), []
    for place, labels in enumerate(LABELS):
        table = R2[:, :, place]
        more = table[:, [module]] - table
        text = f"{labels or 'all'} labels"
        means.append([text, *map(interval_text, table.T)])
        gains = ["" if k == module else interval_text(gain) for k, gain in enumerate(more.T)]
        means.append([f"{text}, module minus", *gains])
        parts.append(([f"stream, {text}", *kinds], _rows(names, table)))
    known = [interval_text(column) for column in novelty.T]
    ends = (["stream", "known", "AUROC"], [*_rows(names, novelty), ["mean", *known]])
    return [(["R2", *kinds], means), *parts, ends]


def _rows(names: Sequence[str], table: FloatArray) -> list[list[str]]:
    rows = [[f"{value:.3f}" for value in row] for row in table]
    return [[name, *row] for name, row in zip(names, rows, strict=True)]


def main(*, quick: bool = False) -> None:
    """Measure, and write results/features.json; quick: two streams, one seed."""
    names = streams()[: 2 if quick else None]
    found: dict[str, list[dict[str, list[float]]]] = {name: [] for name in names}
    for seed in SEEDS[: 1 if quick else None]:
        footage = {name: make_footage(name, seed) for name in names}
        for k, name in enumerate(names):
            others = [footage[names[(k + i) % len(names)]] for i in range(1, OTHERS + 1)]
            found[name].append(measure(footage[name], others))
            print(seed, name, found[name][-1], flush=True)
    kinds = [kind for kind in found[names[0]][0] if kind not in ("known", "AUROC")]

    def over_seeds(*columns: str) -> FloatArray:
        rows = [[[row[kind] for kind in columns] for row in found[name]] for name in names]
        return np.mean(rows, axis=1)

    novelties = over_seeds("known", "AUROC")[:, :, 0]
    tables = tables_of(names, kinds, over_seeds(*kinds), novelties)
    save("features", "What can be read from features", NOTE, tables)
