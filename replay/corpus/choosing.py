"""Which windows of many logs to look at: what differs from all others first, noise not at all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

AREAS: Final = (6, 8)
"""Rows and columns of areas by whose mean brightness noise is told, and known pictures are."""

CELLS: Final = (12, 16)
"""The same of what describes a block."""

RANDOM: Final = 0.8
"""Share of what frames without any order have, above which those of a block have none."""

STILL: Final = 1.0
"""Steps of gray by which the areas of a picture differ over time where only its sensor does."""

ALIKE: Final = 0.1
"""Two blocks are alike below this share of what blocks of their stream differ by in the mean."""

SMALL: Final = 0.5
"""Steps of gray: a feature of pictures that differs by more counts as much as any other."""

NEAR: Final = 3
"""How rare a block is: how far the one is that is the third nearest to it."""

COMPARED: Final = 2000
"""Blocks of a kind of stream, evenly, that all others are compared with for that."""

AT_ONCE: Final = 4096
"""Blocks that are compared at once."""

EVERY: Final = 10
"""One frame in so many of a block is compared with pictures that a run watched."""

Features = NDArray[np.float32]


def areas(frames: NDArray[Any], grid: tuple[int, int]) -> NDArray[np.float64]:
    """Mean brightness of areas of pictures, (n, height, width), or numbers as they are, (n, I).

    Args:
        frames: of either.
        grid: at most so many rows and columns.

    Returns:
        (n, rows, columns) or (n, I).
    """
    found = frames.astype(np.float64)
    for axis, parts in zip((1, 2), grid if frames.ndim == 3 else (), strict=False):
        size = found.shape[axis]
        starts = np.unique(np.arange(parts) * size // parts)
        widths = np.diff([*starts, size])
        shape = [-1 if i == axis else 1 for i in range(3)]
        found = np.add.reduceat(found, starts, axis=axis) / widths.reshape(shape)
    return found


def disorder(values: NDArray[np.float64]) -> float:
    """How little order frames have in time: about 1 where each is independent, 0 where all move on.

    Half of the mean square successive difference, over the variance (von Neumann, 1941:
    Distribution of the ratio of the mean square successive difference to the variance, Annals of
    Mathematical Statistics 12).

    Args:
        values: (n, cells), n above 1.

    Returns:
        0 where nothing changes.
    """
    variance = float(values.var(axis=0, ddof=1).mean())
    steps = np.diff(values, axis=0)
    return float((steps * steps).mean()) / (2 * variance) if variance else 0.0


class Described(NamedTuple):
    """What a block shows, how it moves, and what it is without order.

    Attributes:
        features: (2 areas,) mean and standard deviation over time of each of `AREAS`.
        cells: (3 cells,) mean, standard deviation and mean step of each of `CELLS`.
        looks: (n, areas) its frames in `AREAS`.
        noise: whether it is nothing but noise.
        still: whether nothing moves in it.
    """

    features: Features
    cells: Features
    looks: NDArray[np.float64]
    noise: bool
    still: bool


def described(frames: NDArray[Any]) -> Described:
    """What a block shows.

    Args:
        frames: (n, height, width) uint8 or (n, I), n above 1.
    """
    fine = areas(frames, CELLS)
    looks = areas(fine, AREAS).reshape(len(fine), -1)
    spread = looks.std(axis=0)
    still = float(np.sqrt((spread * spread).mean())) <= (0 if frames.ndim == 2 else STILL)
    noise = not still and disorder(looks) > RANDOM
    values = fine.reshape(len(fine), -1)
    steps = np.abs(np.diff(values, axis=0)).mean(axis=0)
    features = np.concatenate([looks.mean(axis=0), spread])
    cells = np.concatenate([values.mean(axis=0), values.std(axis=0), steps])
    return Described(features.astype(np.float32), cells.astype(np.float32), looks, noise, still)


def usual_distance(variance: float, width: int, *, pictures: bool) -> float:
    """The root mean square distance of two blocks.

    Args:
        variance: of their features, summed.
        width: how many features they have.
        pictures: whether they are of pictures, which differ by `STILL` at least.
    """
    least = STILL * np.sqrt(width) if pictures else 0.0
    return float(max(np.sqrt(2 * variance), least)) or 1.0


def scale(
    features: Features,
    groups: NDArray[np.int64],
    wanted: NDArray[np.bool_],
    pictures: Sequence[bool],
) -> None:
    """Make distances of blocks of a group 1 in the mean square of two, each feature as much.

    Args:
        features: (n, F), of blocks; changed.
        groups: (n,), of which kind of stream each is.
        wanted: (n,), which count; noise would be the measure of all else.
        pictures: of each group, whether it shows pictures: they differ by `STILL` at least, and a
            feature of them by `SMALL`.
    """
    for group, shows in enumerate(pictures):
        own = np.flatnonzero((groups == group) & wanted)
        if not len(own):
            continue
        part = features[own]
        spread = part.std(axis=0)
        squares = float((spread * spread).sum())
        part /= np.maximum(spread, SMALL) if shows else np.where(spread > 0, spread, 1)
        size = float(np.sqrt(2 * part.var(axis=0).sum())) or 1.0
        if squares:  # what hardly differs at all is alike
            size *= usual_distance(squares, part.shape[1], pictures=shows) / np.sqrt(2 * squares)
        features[own] = part / size


def rarity(
    features: Features, groups: NDArray[np.int64], wanted: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """How far each block is from its group's third nearest to it, of those that are wanted.

    A distance to the k-th nearest neighbour tells outliers from what differs only as all do
    (Ramaswamy, Rastogi, Shim, 2000: Efficient algorithms for mining outliers from large data sets,
    SIGMOD).

    Args:
        features: (n, F), of blocks, as `scale` makes them.
        groups: (n,), only blocks of one group are compared.
        wanted: (n,), which count.

    Returns:
        (n,), 0 where nothing is wanted, and where a group has too few.
    """
    found = np.zeros(len(features))
    for group in np.unique(groups).tolist():
        own = np.flatnonzero((groups == group) & wanted)
        others = own[np.unique(np.linspace(0, len(own) - 1, COMPARED).astype(int))]
        if len(others) <= NEAR + 1:
            continue
        for at in range(0, len(own), AT_ONCE):
            some = own[at : at + AT_ONCE]
            away = distances(features[some], features[others])
            itself = np.isin(some, others)
            nearest = np.partition(away, (NEAR - 1, NEAR), axis=1)
            found[some] = nearest[np.arange(len(some)), NEAR - 1 + itself]
    return found


def distances(some: NDArray[Any], others: NDArray[Any]) -> NDArray[Any]:
    """Of each of (n, F) to each of (m, F), (n, m)."""
    squares = (some * some).sum(axis=1)[:, None] + (others * others).sum(axis=1)
    found: NDArray[Any] = np.sqrt(np.maximum(squares - 2 * some @ others.T, 0))
    return found


def spread_out(
    features: Features,
    groups: NDArray[np.int64],
    windows: NDArray[np.int64],
    wanted: NDArray[np.bool_],
    rare: NDArray[np.float64],
    strange: NDArray[np.float64],
    seconds: NDArray[np.float64],
    budget: float = np.inf,
) -> tuple[list[tuple[int, float]], bool]:
    """Windows in which more is seen with each than with any other: the farthest comes first.

    Of every group the block nearest to its mean is first, then always the one that is farthest
    from all that were chosen (Gonzalez, 1985: Clustering to minimize the maximum intercluster
    distance, Theoretical Computer Science 38) and rarest, the sum of both. All blocks of a window
    are seen with it. A window that does not fit into what is left of the budget is passed over.

    Args:
        features: (n, F), of blocks, as `scale` makes them.
        groups: (n,), only blocks of one group are compared.
        windows: (n,), in which window each is.
        wanted: (n,), which may be chosen.
        rare: (n,), see `rarity`.
        strange: (n,), how far each is from what is known before, infinite where nothing is.
        seconds: (W,), of windows.
        budget: seconds of all that are chosen.

    Returns:
        The windows with that sum, 1 for the first of a group; and whether all others are `ALIKE`
        to those, so that a longer budget would choose no more.
    """
    away = np.where(wanted, strange, -1.0)
    lasts = seconds[windows]
    in_order = np.argsort(windows, kind="stable")
    firsts = np.searchsorted(windows[in_order], np.arange(len(seconds) + 1))
    members = {group: np.flatnonzero(groups == group) for group in np.unique(groups).tolist()}
    first = np.zeros(len(features))
    for own in members.values():
        usual = features[own][wanted[own]]
        if len(usual):
            first[own] = -np.linalg.norm(features[own] - usual.mean(axis=0), axis=1)
    found: list[tuple[int, float]] = []
    all_seen = True
    while len(away):
        too_long = lasts > budget + 1e-9
        all_seen = all_seen and not (away[too_long] > ALIKE).any()
        away[too_long] = -1.0
        new = np.where(away > ALIKE, away + rare, -1.0)
        farthest = float(new.max())
        if farthest < 0:
            break
        ties = np.flatnonzero(new == farthest)
        window = int(windows[ties[np.argmax(first[ties])]])
        found.append((window, 1.0 if farthest == np.inf else farthest))
        budget -= float(seconds[window])
        for seen in in_order[firsts[window] : firsts[window + 1]].tolist():
            own = members[int(groups[seen])]
            if wanted[seen]:
                near = np.linalg.norm(features[own] - features[seen], axis=1)
                away[own] = np.minimum(away[own], near)
            away[seen] = -1.0
    return found, all_seen
