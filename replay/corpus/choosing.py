"""Which windows of many logs to look at: what differs from all others first, noise not at all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

CELLS: Final = (6, 8)
"""Rows and columns of areas whose mean brightness describes a picture."""

RANDOM: Final = 0.8
"""Share of what frames without any order have, above which those of a block have none."""

STILL: Final = 1.0
"""Steps of gray by which the areas of a picture differ over time where only its sensor does."""

ALIKE: Final = 0.1
"""Two blocks are alike below this share of what blocks of their stream differ by in the mean."""

Features = NDArray[np.float32]


def cells(frames: NDArray[Any]) -> NDArray[np.float64]:
    """Mean brightness of areas of pictures, (n, height, width), or numbers as they are, (n, I).

    Returns:
        (n, cells).
    """
    if frames.ndim == 2:
        return frames.astype(np.float64)
    found = frames.astype(np.float64)
    for axis, parts in zip((1, 2), CELLS, strict=True):
        size = found.shape[axis]
        starts = np.unique(np.arange(parts) * size // parts)
        widths = np.diff([*starts, size])
        shape = [-1 if i == axis else 1 for i in range(3)]
        found = np.add.reduceat(found, starts, axis=axis) / widths.reshape(shape)
    return found.reshape(len(found), -1)


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


def described(frames: NDArray[Any]) -> tuple[Features, bool, bool]:
    """What a block shows and how it moves, (2 cells,); whether it is noise, and whether still.

    Args:
        frames: (n, height, width) uint8 or (n, I), n above 1.
    """
    values = cells(frames)
    spread = values.std(axis=0)
    still = float(np.sqrt((spread * spread).mean())) <= (0 if frames.ndim == 2 else STILL)
    noise = not still and disorder(values) > RANDOM
    return np.concatenate([values.mean(axis=0), spread]).astype(np.float32), noise, still


def usual_distance(variance: float, width: int, *, pictures: bool) -> float:
    """The root mean square distance of two blocks.

    Args:
        variance: of their features, summed.
        width: how many features they have.
        pictures: whether they are of pictures, which differ by `STILL` at least.
    """
    least = STILL * np.sqrt(width) if pictures else 0.0
    return float(max(np.sqrt(2 * variance), least)) or 1.0


def scaled(features: Features, groups: NDArray[np.int64], pictures: Sequence[bool]) -> Features:
    """Blocks of each group with distances that are 1 in the mean square of two of them.

    Args:
        features: (n, F), of blocks.
        groups: (n,), of which kind of stream each is.
        pictures: of each group, whether it shows pictures, which differ by `STILL` at least.
    """
    found = features.copy()
    for group, shows in enumerate(pictures):
        own = groups == group
        if not own.any():
            continue
        variance = float(features[own].var(axis=0).sum())
        found[own] /= usual_distance(variance, features.shape[1], pictures=shows)
    return found


def spread_out(
    features: Features,
    groups: NDArray[np.int64],
    windows: NDArray[np.int64],
    wanted: NDArray[np.bool_],
    seconds: NDArray[np.float64],
    budget: float = np.inf,
) -> tuple[list[tuple[int, float]], bool]:
    """Windows in which more is seen with each than with any other: the farthest comes first.

    Of every group the block nearest to its mean is first, then always the block that is farthest
    from all that were chosen (Gonzalez, 1985: Clustering to minimize the maximum intercluster
    distance, Theoretical Computer Science 38). So no block is farther from one that was chosen
    than twice what as many could come to. All blocks of a window are seen with it. A window that
    does not fit into what is left of the budget is passed over.

    Args:
        features: (n, F), of blocks, as `scaled` gives them.
        groups: (n,), only blocks of one group are compared.
        windows: (n,), in which window each is.
        wanted: (n,), which may be chosen.
        seconds: (W,), of windows.
        budget: seconds of all that are chosen.

    Returns:
        The windows with how far each was from those before, 1 for the first of a group; and
        whether all others are `ALIKE`, so that a longer budget would choose no more.
    """
    away = np.where(wanted, np.inf, -1.0)
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
        farthest = float(away.max())
        if farthest <= ALIKE:
            break
        ties = np.flatnonzero(away == farthest)
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
