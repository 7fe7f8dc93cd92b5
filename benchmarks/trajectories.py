"""Features of many short trajectories of images: principal components, batch SFA, a module."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

import cdmisfa
from cdmisfa.core.arrays import FloatArray
from cdmisfa.modules import Module

# Images of one trajectory, (n, height, width), from 0 to 255.
Images = NDArray[Any]

# Outputs (n, J) of the images of one trajectory.
Features = Callable[[Images], FloatArray]

STUDENT = {2: 12.706, 3: 4.303, 10: 2.262}
"""97.5 % quantile of Student's distribution by the number of values."""


def interval(values: Sequence[float], digits: int) -> str:
    """Return the mean of the values of seeds and its 95 % interval (Student).

    NaN stands for a seed without features; without an interval, it counts the seeds that have them.
    """
    known = [value for value in values if np.isfinite(value)]
    if len(known) < len(values):
        part = f"({len(known)} of {len(values)})"
        return f"{np.mean(known):.{digits}f} {part}" if known else "rejected"
    half = STUDENT[len(known)] * float(np.std(known, ddof=1)) / np.sqrt(len(known))
    return f"{np.mean(known):.{digits}f} ± {half:.{digits}f}"


def learn_module(trajectories: Sequence[Images], **options: Any) -> Module | None:
    """Return the module that `cdmisfa.learn` saves, with each trajectory as an episode.

    Args:
        trajectories: images of each; nothing is learned across the end of one.
        options: of `cdmisfa.learn`.

    Returns:
        The module; None if the learner rejects the stream.
    """
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about the rate of arrays, and rejected streams
        files = [Path(folder) / f"{number:06d}.npy" for number in range(len(trajectories))]
        for file, images in zip(files, trajectories, strict=True):
            np.save(file, images)
        how = {"algorithm": "progress", "episodes": True, "max_modules": 1, **options}
        run = cdmisfa.learn(files, **how)
        return run.modules[0] if run.modules else None


def rows(images: Images) -> NDArray[Any]:
    """Return images as rows of pixels from 0 to 1."""
    return images.reshape(len(images), -1).astype(np.float32) / 255


def linear(mean: FloatArray, weights: FloatArray) -> Features:
    """Return linear features with weights (J, pixels)."""
    return lambda images: (rows(images) - mean) @ weights.T


def components(trajectories: Sequence[Images], count: int) -> tuple[FloatArray, FloatArray]:
    """Return the mean and the largest whitened principal components (count, pixels)."""
    x = np.concatenate([rows(images) for images in trajectories])
    mean, last = x.mean(axis=0), x.shape[1] - 1
    x -= mean
    variance, directions = eigh(x.T @ x / len(x), subset_by_index=[last - count + 1, last])
    return mean, (directions / np.sqrt(variance)).T[::-1]


def slow_features(
    trajectories: Sequence[Images], basis: tuple[FloatArray, FloatArray], count: int
) -> Features:
    """Return the slowest features of batch SFA among whitened components (K, pixels)."""
    mean, whitening = basis
    moves = [np.diff((rows(images) - mean) @ whitening.T, axis=0) for images in trajectories]
    change = np.concatenate(moves)
    _, rotation = np.linalg.eigh(change.T @ change)
    return linear(mean, rotation[:, :count].T @ whitening)
