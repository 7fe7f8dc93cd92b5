"""Columns of image features: images unlike all other episodes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np

from cdmisfa.core.arrays import FloatArray
from cdmisfa.features.recursive import RecursiveFeature
from replay.episodes.measure import CameraMeasures, period
from replay.episodes.numbers import Column, column

# Slow features of an image, and principal components that they are learned from. The same number of
# principal components finds as much; slow features are learned in one pass without a covariance.
FEATURES: Final = 16
COMPONENTS: Final = 24

# Nearest images of other episodes that an image is compared with.
NEIGHBORS: Final = 3

# Seconds between two images that are compared, and largest number of them: the time that this takes
# grows with its square.
EVERY: Final = 0.3
MOST_COMPARED: Final = 20_000


class Features(NamedTuple):
    """Features of the images of all episodes.

    Attributes:
        slow: for each episode (T, 16) slow features of its images, of variance 1.
        rows: for each episode numbers of the images that are compared.
        components: for each episode the principal components of these images.
    """

    slow: list[FloatArray]
    rows: list[range]
    components: list[FloatArray]


def features_of(cameras: Sequence[CameraMeasures]) -> Features:
    """Learn features of the images of all episodes in one pass, and compute them."""
    sfa = RecursiveFeature(cameras[0].thumbnails.shape[1], COMPONENTS, FEATURES, window=10**6)
    for camera in cameras:
        sfa.update(np.ascontiguousarray(camera.thumbnails), gap=True)
    total = sum(len(camera.times) for camera in cameras)
    result = Features([], [], [])
    for camera in cameras:
        step = max(round(EVERY / max(period(camera.times), 1e-3)), -(-total // MOST_COMPARED), 1)
        rows = range(0, len(camera.times), step)
        images = camera.thumbnails / np.float32(255) - sfa.mean.astype(np.float32)
        result.slow.append(images @ sfa.phi.T)
        result.rows.append(rows)
        result.components.append(images[::step] @ sfa.state.basis.T)
    return result


def unlike_columns(cameras: Sequence[CameraMeasures], features: Features) -> list[Column]:
    """Return how far images are from the nearest images of other episodes.

    unlike = log of the mean over images of d, d the mean distance to the 3 nearest images
        of other episodes in 16 slow features
    covered = log of the 0.9 quantile over images of d, in 48 principal components

    Equation: E12
    Equation: E13
    """
    slow = [part[:: rows.step] for part, rows in zip(features.slow, features.rows, strict=True)]
    columns = []
    for reason, parts, level in (("unlike", slow, None), ("covered", features.components, 0.9)):
        values, at = [], []
        for camera, rows, near in zip(cameras, features.rows, nearest(parts), strict=True):
            values.append(np.mean(near) if level is None else np.quantile(near, level))
            at.append(camera.times[rows[int(near.argmax())]])
        columns.append(column(reason, np.log(np.array(values) + 1e-9), values, at))
    return columns


def nearest(parts: Sequence[FloatArray]) -> Iterator[FloatArray]:
    """Yield for each episode the mean distance of its images to the nearest of other episodes.

    It is NaN if there are no other episodes.
    """
    owner = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    images = np.concatenate(parts).astype(np.float32)
    size = (images * images).sum(1)
    for i in range(len(parts)):
        mine, rest = owner == i, owner != i
        if rest.sum() <= NEIGHBORS:
            yield np.full(mine.sum(), np.nan)
            continue
        square = size[mine][:, None] + size[rest] - 2 * images[mine] @ images[rest].T
        least = np.partition(square, NEIGHBORS, axis=1)[:, :NEIGHBORS]
        yield np.sqrt(np.maximum(least, 0)).mean(1)
