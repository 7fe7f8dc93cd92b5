"""Statistics of the numbers and pictures of a dataset, as LeRobot has them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from replay.export.frames import pieces
from replay.inputs import Logged
from replay.stored import Span

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}

Stats = dict[str, NDArray[Any]]


def number_stats(values: NDArray[Any]) -> Stats:
    rows = values.astype(np.float64).reshape(len(values), -1)
    return {
        "min": rows.min(axis=0),
        "max": rows.max(axis=0),
        "mean": rows.mean(axis=0),
        "std": rows.std(axis=0),
        "count": np.array([len(rows)]),
        **{key: np.quantile(rows, q, axis=0) for key, q in QUANTILES.items()},
    }


def aggregated(parts: Sequence[Stats]) -> Stats:
    """Statistics of all from those of parts, as LeRobot's: quantiles are means of quantiles."""
    counts = np.array([float(part["count"][0]) for part in parts])

    def mean(values: list[NDArray[Any]]) -> NDArray[Any]:
        return np.average(values, axis=0, weights=counts)

    middle = mean([part["mean"] for part in parts])
    return {
        "min": np.min([part["min"] for part in parts], axis=0),
        "max": np.max([part["max"] for part in parts], axis=0),
        "mean": middle,
        "std": np.sqrt(mean([part["std"] ** 2 + (part["mean"] - middle) ** 2 for part in parts])),
        "count": np.array([int(counts.sum())]),
        **{key: mean([part[key] for part in parts]) for key in QUANTILES},
    }


def as_lists(stats: Stats) -> dict[str, Any]:
    return {key: value.tolist() for key, value in stats.items()}


def values_shown(source: Logged, stream: int, span: Span) -> NDArray[np.int64]:
    """How often each value is a pixel of a view in some frames, (256,)."""
    counts = np.zeros(256, dtype=np.int64)
    for block in pieces(source, stream, [span]):
        counts += np.bincount(block.frames.reshape(-1), minlength=256)
    return counts


def image_stats(counts: NDArray[np.int64], frames: int) -> Stats:
    """Statistics of pixels from 0 to 1, (3, 1, 1) each, from how often each value is."""
    levels, total = np.arange(256) / 255, counts.sum()
    seen, below = levels[counts > 0], np.cumsum(counts)
    mean = (levels * counts).sum() / total
    found = {
        "min": seen[0],
        "max": seen[-1],
        "mean": mean,
        "std": np.sqrt(((levels - mean) ** 2 * counts).sum() / total),
        **{key: levels[np.searchsorted(below, q * total)] for key, q in QUANTILES.items()},
    }
    stats = {key: np.full((3, 1, 1), value) for key, value in found.items()}
    return {**stats, "count": np.array([frames])}
