"""Statistics of the numbers and images of episodes, as LeRobot stores them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from replay.logs.formats.lerobot_layout import Stats

# Pixels of the longer side of an image that its statistics count, as in LeRobot.
SAMPLED = 150

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


def number_stats(values: NDArray[Any]) -> Stats:
    """Return LeRobot's statistics of (n,) or (n, k) numbers."""
    rows = values.astype(np.float64).reshape(len(values), -1)
    return {
        "min": rows.min(axis=0),
        "max": rows.max(axis=0),
        "mean": rows.mean(axis=0),
        "std": rows.std(axis=0),
        "count": np.array([len(rows)]),
        **{key: np.quantile(rows, q, axis=0) for key, q in QUANTILES.items()},
    }


class ImageStats:
    """LeRobot's statistics of pixels from 0 to 1, (3, 1, 1) each, from a histogram a channel."""

    def __init__(self) -> None:
        self._counts, self._images = np.zeros((3, 256), np.int64), 0

    def add(self, images: NDArray[Any]) -> None:
        """Count the pixels of images (n, height, width, 1 or 3)."""
        longest = max(images.shape[1:3])
        step = longest // SAMPLED if longest >= 2 * SAMPLED else 1
        for image in images[:, ::step, ::step]:  # Pillow counts faster than NumPy
            pixels = Image.fromarray(image if image.shape[2] == 3 else image[:, :, 0])
            self._counts += np.reshape(pixels.histogram(), (-1, 256))
        self._images += len(images)

    def result(self) -> Stats:
        """Return the statistics of all images."""
        levels, counts = np.arange(256) / 255, self._counts
        total, below = counts[0].sum(), np.cumsum(counts, axis=1)
        mean = counts @ levels / total
        values = {
            "min": [levels[row > 0][0] for row in counts],
            "max": [levels[row > 0][-1] for row in counts],
            "mean": mean,
            "std": np.sqrt(((levels - mean[:, None]) ** 2 * counts).sum(axis=1) / total),
            **{
                key: [levels[np.searchsorted(row, q * total)] for row in below]
                for key, q in QUANTILES.items()
            },
        }
        stats = {key: np.reshape(value, (3, 1, 1)) for key, value in values.items()}
        return {**stats, "count": np.array([self._images])}
