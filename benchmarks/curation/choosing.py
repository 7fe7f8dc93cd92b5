"""What to look at of recordings, by `curate` and by simpler means at the same budget."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow.parquet as pq
from sklearn.decomposition import PCA

import cdmisfa
from benchmarks.curation.planting import FPS, Planted, plant
from benchmarks.curation.worlds import NOISES, WORLDS
from cdmisfa.core.arrays import FloatArray
from cdmisfa.experiments.apply import Application
from replay.corpus.curate import curate
from replay.corpus.finding import INDEX

WINDOW: Final = 40
"""Frames of what is chosen at once, as of the blocks of `curate`."""

BUDGET: Final = 0.1
"""Share of the time of all recordings that may be chosen."""

SECOND: Final = FPS
"""Frames of an event that must be chosen for it to be found."""

COMPONENTS: Final = 32
"""Of the principal components."""

EVERY: Final = 10
"""One frame in so many is what principal components are fitted on."""

Chosen = Mapping[str, np.ndarray[Any, Any]]
"""Which frames of each recording were chosen, (n,) bool."""

MEANS: Final = ("random", "differences", "components")
"""That `curate` is compared with."""

APART: Final = ", set apart"
"""Of means that choose of what `curate` finds no noise and no double."""


def by_curate(folder: Path, out: Path, budget: float, *, known: bool) -> Any:
    """What `curate` finds of the recordings in a folder."""
    run = folder / "run" if known else None
    application = Application(run) if run else None
    index = folder / "logs" / INDEX
    return curate(index, out, known=application, known_as=run, budget=budget, force=True)


def chosen_of(planted: Planted, segments: Sequence[Mapping[str, Any]]) -> Chosen:
    """Frames of segments."""
    found = {name: np.zeros(len(frames), bool) for name, frames in planted.frames.items()}
    for segment in segments:
        low, high = segment["t"]
        found[segment["log"]][low:high] = True
    return found


def set_apart(out: Path, planted: Planted) -> set[tuple[str, int]]:
    """Windows that `curate` finds no noise, of recordings that hold not the same as another."""
    blocks = pq.read_table(out / "blocks.parquet").to_pylist()
    return {(b["log"], b["t"] // WINDOW) for b in blocks if b["verdict"] != "noise"}


def ranked(
    how: str, planted: Planted, wanted: set[tuple[str, int]] | None, seed: int, *, known: bool
) -> list[tuple[str, int]]:
    """Windows in the order of what to look at first.

    Args:
        how: "random", "differences" or "components".
        planted: the recordings.
        wanted: windows that may be chosen; by default all.
        seed: of a random order.
        known: what looks as the recording that the known run learned from is not looked at.
    """
    windows = [
        (name, i)
        for name, frames in sorted(planted.frames.items())
        for i in range(len(frames) // WINDOW)
    ]
    own = [window for window in windows if wanted is None or window in wanted]
    if how == "random":
        return [own[i] for i in np.random.default_rng(seed).permutation(len(own)).tolist()]
    shown = [planted.frames[name][i * WINDOW : (i + 1) * WINDOW] for name, i in own]
    if how == "differences":
        moves = [np.abs(np.diff(frames.astype(np.int16), axis=0)).mean() for frames in shown]
        return [own[i] for i in np.argsort(moves, kind="stable")[::-1].tolist()]
    features = embedded(planted, shown)
    chosen = np.zeros((0, features.shape[1]))
    if known:
        usual = planted.usual[: len(planted.usual) // WINDOW * WINDOW]
        chosen = embedded(planted, usual.reshape(-1, WINDOW, *usual.shape[1:]))
    return [own[i] for i in farthest(features, chosen)]


def embedded(planted: Planted, windows: Sequence[Any]) -> FloatArray:
    """Mean principal components of windows, (n, COMPONENTS)."""
    sample = np.concatenate([frames[::EVERY] for frames in planted.frames.values()])
    pca = PCA(COMPONENTS, random_state=0).fit(sample.reshape(len(sample), -1) / 255)
    return np.array([pca.transform(w.reshape(len(w), -1) / 255).mean(axis=0) for w in windows])


def farthest(features: FloatArray, chosen: FloatArray) -> list[int]:
    """Always what is farthest from all before: the order of all, (n,)."""
    if len(chosen):
        away = np.linalg.norm(features[:, None] - chosen, axis=2).min(axis=1)
    else:
        away = -np.linalg.norm(features - features.mean(axis=0), axis=1)
    order: list[int] = []
    for turn in range(len(features)):
        order.append(int(np.argmax(away)))
        near = np.linalg.norm(features - features[order[-1]], axis=1)
        away = near if turn == 0 and not len(chosen) else np.minimum(away, near)
        away[order] = -np.inf
    return order


def first(planted: Planted, order: Sequence[tuple[str, int]], budget: float) -> Chosen:
    """As much of an order as fits into a budget of seconds."""
    found = {name: np.zeros(len(frames), bool) for name, frames in planted.frames.items()}
    for name, i in order[: int(budget * FPS / WINDOW)]:
        found[name][i * WINDOW : (i + 1) * WINDOW] = True
    return found


def judged(planted: Planted, chosen: Chosen) -> dict[str, Any]:
    """What was chosen, against what was planted.

    Returns:
        `found`: for each event, its kind and whether a second of it was chosen, whichever of
        doubles it is in; `precision`: the share of the chosen time that lies in events, where what
        is shown for the second time counts as none; `noise` and `twice`: the shares that are
        noise, and that are shown for the second time; `seconds`: the chosen time.
    """
    total = sum(int(each.sum()) for each in chosen.values()) or 1
    seen = {name: each.copy() for name, each in chosen.items()}
    twice = 0
    for name, of in planted.twice.items():
        twice += int((seen[name] & seen[of]).sum())
        seen[of] |= seen.pop(name)
    hits = [int(seen[e.log][e.start : e.stop].sum()) for e in planted.events]
    return {
        "found": [[e.kind, n >= SECOND] for e, n in zip(planted.events, hits, strict=True)],
        "precision": sum(hits) / total,
        "noise": sum(int(chosen[name].sum()) for name in planted.noise) / total,
        "twice": twice / total,
        "seconds": sum(int(each.sum()) for each in chosen.values()) / FPS,
    }


def trial(task: tuple[str, str, int]) -> dict[str, Any]:
    """All means on the recordings of a world: its group, its name, and the seed."""
    group, name, seed = task
    world, noises = WORLDS[group][name], NOISES[group]
    chosen_noises = [noises[(2 * seed + k) % len(noises)] for k in range(2)]
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        planted = plant(folder, world, chosen_noises, seed)
        budget = sum(map(len, planted.frames.values())) / FPS * BUDGET
        learned = bool(cdmisfa.Run(folder / "run").modules)
        for known in (False, True):
            if known and not learned:
                continue
            curated = by_curate(folder, folder / "out", budget, known=known)
            means = {"curate": chosen_of(planted, curated.segments)}
            wanted = set_apart(folder / "out", planted)
            for how in ("components",) if known else MEANS:
                for label, of in (("", None), (APART, wanted)):
                    order = ranked(how, planted, of, seed, known=known)
                    means[how + label] = first(planted, order, budget)
            end = ", known" if known else ""
            found |= {how + end: judged(planted, chosen) for how, chosen in means.items()}
    possible = sum(e.stop - e.start for e in planted.events) / FPS / budget
    return {
        "group": group,
        "world": name,
        "seed": seed,
        "noise": chosen_noises,
        "learned": learned,
        "budget": budget,
        "possible": min(possible, 1.0),
        "means": found,
    }
