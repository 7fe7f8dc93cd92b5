"""Groups of episodes that are compared within themselves: tasks, sessions, or views that differ."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from cdmisfa.core.arrays import FloatArray, IntArray
from cdmisfa.core.errors import UsageError
from replay.episodes.measure import Measured
from replay.episodes.reading import EpisodeLog

# Smallest group, as a share of all episodes and in episodes.
SHARE: Final = 0.1
SMALLEST: Final = 6

# Difference of two pixels, in standard deviations of a view, beyond which it counts no more: things
# on the table move between episodes, and a camera that is moved changes all edges a little.
CLIP: Final = 0.3

# Silhouette from which on two groups of views are apart. On simulated episodes of one task and
# session it is at most 0.29, of two sessions at least 0.57, of two tasks 0.15 to 0.64.
APART: Final = 0.32

# Random pairs of episodes with which a search for two groups begins.
BEGINNINGS: Final = 40

_SIZE: Final = (40, 30)


def groups_of(
    logs: Sequence[EpisodeLog], episodes: Sequence[Measured], by: str | None
) -> dict[str, IntArray]:
    """Return the episodes of each group, by a name.

    Args:
        logs: the episodes.
        episodes: their measures.
        by: a column of the dataset; None: its tasks, and views that differ clearly.

    Raises:
        UsageError: the dataset has no such column.
    """
    column = by or "task"
    known = sorted({name for log in logs for name in log.about})
    if by and by not in known:
        raise UsageError(f"--by {by}: the dataset has {', '.join(known) or 'no columns'}")
    labels = [log.about.get(column, "") for log in logs]
    smallest = max(SMALLEST, SHARE * len(episodes))
    rare = {label for label in labels if labels.count(label) < smallest}
    labels = ["others" if label in rare else label for label in labels]
    groups: dict[str, IntArray] = {}
    for label in dict.fromkeys(labels):
        members = np.flatnonzero([other == label for other in labels])
        name = f"{column} {label}" if len(set(labels)) > 1 else ""
        parts = [members] if by else by_views(episodes, members)
        for number, part in enumerate(parts):
            words = [name, f"view {number + 1}" if len(parts) > 1 else ""]
            groups[", ".join(filter(None, words))] = part
    return groups


def by_views(episodes: Sequence[Measured], members: IntArray) -> list[IntArray]:
    """Split episodes in two, again and again, as long as their still views are clearly apart."""
    views = [still_view(episodes[i]) for i in members]
    sizes = [view.size for view in views]
    common = max(set(sizes), key=sizes.count)
    if not common or sizes.count(common) < len(sizes) / 2:
        return [members]
    # An episode without all cameras goes to the first group.
    points = np.stack([v if v.size == common else np.zeros(common, np.float32) for v in views])
    apart = np.stack([np.minimum(np.abs(points - one), CLIP).mean(1) for one in points])
    return [members[part] for part in _split(apart, np.arange(len(members)), len(members))]


def _split(apart: FloatArray, part: IntArray, total: int) -> list[IntArray]:
    """Return a part as two groups and their own parts, or as one."""
    smallest = max(SMALLEST, SHARE * total)
    if len(part) < 2 * smallest:
        return [part]
    inside = apart[np.ix_(part, part)]
    # Random beginnings with a fixed seed: some of them are in different groups.
    rng = np.random.default_rng(0)
    best, halves = APART, None
    for _ in range(BEGINNINGS):
        medoids = rng.choice(len(part), 2, replace=False)
        for _ in range(10):
            second = inside[:, medoids[1]] < inside[:, medoids[0]]
            if min(second.sum(), (~second).sum()) < smallest:
                break
            groups = [np.flatnonzero(~second), np.flatnonzero(second)]
            medoids = np.array([g[inside[np.ix_(g, g)].sum(1).argmin()] for g in groups])
        else:
            if (score := silhouette(inside, second)) > best:
                best, halves = score, second
    if halves is None:
        return [part]
    return [*_split(apart, part[~halves], total), *_split(apart, part[halves], total)]


def silhouette(apart: FloatArray, second: NDArray[np.bool_]) -> float:
    """Return how clearly two groups are apart, from 0 to 1: the smaller median of both groups.

    s = median of (b - a) / max(a, b), a and b the median distance to one's own group
        and to the other
    """
    first = ~second
    middle = np.stack([np.median(apart[:, part], axis=1) for part in (first, second)], axis=1)
    inner, outer = np.where(second[:, None], middle[:, ::-1], middle).T
    values = (outer - inner) / np.maximum(np.maximum(inner, outer), 1e-9)
    return float(min(np.median(values[first]), np.median(values[second])))


def still_view(episode: Measured) -> FloatArray:
    """Return the still views of all cameras, of mean 0 and variance 1, small, one after another."""
    parts = []
    for camera in episode.cameras.values():
        for view in (camera.begin, camera.end):
            small = np.asarray(Image.fromarray(view).resize(_SIZE, Image.Resampling.BOX))
            parts.append((small - small.mean()) / (small.std() + 1e-6))
    return np.concatenate([part.ravel() for part in parts]) if parts else np.zeros(0)
