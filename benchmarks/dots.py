"""A moving dot in noise: how well features of its images tell where it is.

The dot is that of Sobal et al. 2022, "Joint Embedding Predictive Architectures Focus on Slow
Features" (arXiv:2211.10831), as their published code draws it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from benchmarks import trajectories
from benchmarks.report import save
from benchmarks.trajectories import Features, Images, components, interval, slow_features
from cdmisfa.core.arrays import FloatArray
from cdmisfa.modules import Module

SIZE, DEVIATION, STEP = 28, 1.3, 4.0
"""Pixels of an image's side, of the dot's standard deviation, and of its longest step."""

CONCENTRATION = 0.2
"""Of the directions of the steps of a trajectory (von Mises)."""

FRAMES = 17_000
"""Frames to learn from, as many to fit the probe, and as many to judge it."""

LENGTHS = (17, 170)
"""Frames of a trajectory: in the paper 17."""

NOISES = ("changing", "slow", "fixed")
LEVELS = (0.5, 1.5)
LABELS = (5_000, 100)
"""Frames with a known position to fit the probe."""

PENALTIES = (1e-3, 3e-2, 1.0)
"""Of the probe, as a share of the number of frames; one is chosen."""


def move(rng: np.random.Generator, count: int, length: int) -> FloatArray:
    """Return positions of the dot in pixels, (count, length, 2)."""
    low, high = 2 * DEVIATION, SIZE - 1 - 2 * DEVIATION
    heading = rng.uniform(0, 2 * np.pi, (count, 1))
    angle = heading + rng.vonmises(0, CONCENTRATION, (count, length - 1))
    steps = np.stack([np.cos(angle), np.sin(angle)], axis=2)
    steps *= rng.uniform(0, STEP, (count, length - 1, 1))
    places = [rng.uniform(low, high, (count, 2))]
    for step in steps.swapaxes(0, 1):
        places.append(np.clip(places[-1] + step, low, high))
    return np.stack(places, axis=1)


def draw(places: FloatArray) -> FloatArray:
    """Return images of the dot, 1 in its middle."""
    x, y = (
        np.exp(-((np.arange(SIZE) - places[..., axis, None]) ** 2) / (2 * DEVIATION**2))
        for axis in (0, 1)
    )
    return np.asarray(y[..., :, None] * x[..., None, :])


def make_noise(rng: np.random.Generator, noise: str, shape: tuple[int, ...]) -> FloatArray:
    """Return noise from 0 to 1 for images of a shape (count, length, SIZE, SIZE).

    `slow` noise turns, within a trajectory, from one random image into another.
    """
    count, length = shape[:2]
    drawn = {"changing": length, "slow": 2, "fixed": 1}[noise]
    images = rng.random((count, drawn, SIZE, SIZE))
    if noise == "slow":
        angle = np.linspace(0, np.pi / 2, length)[:, None, None]
        first, last = (images[:, k : k + 1] - 0.5 for k in (0, 1))
        images = 0.5 + (np.cos(angle) * first + np.sin(angle) * last) / np.sqrt(2)
    return np.broadcast_to(images, shape)


def dataset(rng: np.random.Generator, length: int, noise: str, level: float
            ) -> tuple[list[Images], FloatArray]:  # fmt: skip
    """Return trajectories of images, and the dot's positions in image widths, (frames, 2)."""
    places = move(rng, FRAMES // length, length)
    images = draw(places)
    if level:
        images = (images + level * make_noise(rng, noise, images.shape)) / (1 + level)
    return list(np.rint(255 * images).astype(np.uint8)), places.reshape(-1, 2) / SIZE


def ridge(x: FloatArray, places: FloatArray, penalty: float, query: FloatArray) -> FloatArray:
    """Return the positions of a query that ridge regression from (n, J) features predicts."""
    mean, scale = x.mean(axis=0), x.std(axis=0)
    scale[scale < 1e-9] = 1  # constant outputs
    x = (x - mean) / scale
    gram = x.T @ x + penalty * len(x) * np.eye(x.shape[1])
    weights = np.linalg.solve(gram, x.T @ (places - places.mean(axis=0)))
    return np.asarray((query - mean) / scale @ weights + places.mean(axis=0))


def distance(places: FloatArray, truth: FloatArray) -> float:
    """Return the root mean square distance of positions."""
    return float(np.sqrt(((places - truth) ** 2).sum(axis=1).mean()))


def probe(inputs: Sequence[FloatArray], targets: Sequence[FloatArray], labels: int) -> float:
    """Return the error of positions that ridge regression predicts.

    Args:
        inputs: (n, J) features of the frames to fit, and to judge.
        targets: their positions, (n, 2).
        labels: number of the frames to fit that are used, spread evenly; their last quarter
            chooses the penalty.
    """
    step, cut = len(inputs[0]) // labels, 3 * labels // 4
    x, place = inputs[0][::step][:labels], targets[0][::step][:labels]
    tried = [distance(ridge(x[:cut], place[:cut], p, x[cut:]), place[cut:]) for p in PENALTIES]
    best = PENALTIES[int(np.argmin(tried))]
    return distance(ridge(x, place, best, inputs[1]), targets[1])


def uncentred(module: Module) -> Features:
    """Return the outputs of a module on images from which no mean is subtracted."""
    return lambda images: module.rows(images, centre=False) @ module.phi.T


def methods(learn: Sequence[Images]) -> dict[str, Features | None]:
    """Return the features of each method, learned from trajectories; None if it rejects them."""
    mean, whitening = components(learn, 64)
    within = [images - images.mean(axis=0) for images in learn]
    tau = min(40, len(learn[0]))  # a block must fit into a trajectory
    module = trajectories.learn_module(learn, tau=tau)
    centred = trajectories.learn_module(learn, tau=tau, centre="episode")
    return {
        "none: mean position": lambda images: np.zeros((len(images), 1)),
        "all pixels": trajectories.rows,
        "8 principal components": trajectories.linear(mean, whitening[:8]),
        "16 principal components": trajectories.linear(mean, whitening[:16]),
        "batch SFA, 8 of 16": slow_features(learn, (mean, whitening[:16]), 8),
        "batch SFA, 16 of 64": slow_features(learn, (mean, whitening), 16),
        "batch SFA within, 16 of 64": slow_features(within, components(within, 64), 16),
        "module": module.transform if module else None,
        "`--centre episode`": centred.transform if centred else None,
        "`--centre episode`, within": uncentred(centred) if centred else None,
    }


def measure(length: int, noise: str, level: float, seeds: int) -> dict[str, list[list[float]]]:
    """Return errors with each number of labels, for each method and seed; NaN without features."""
    errors = defaultdict[str, list[list[float]]](list)
    for seed in range(seeds):
        rng = np.random.default_rng([seed, length, NOISES.index(noise), int(10 * level)])
        learn, *rest = (dataset(rng, length, noise, level) for _ in range(3))
        for name, features in methods(learn[0]).items():
            if features is None:
                errors[name].append([np.nan] * len(LABELS))
                continue
            y = [np.concatenate([features(images) for images in part[0]]) for part in rest]
            places = [part[1] for part in rest]
            errors[name].append([probe(y, places, labels) for labels in LABELS])
    return errors


def main(*, quick: bool = False) -> None:
    """Measure, and write results/dots.json."""
    seeds, tables = 2 if quick else 3, []
    cases = [("changing", 0.0), *((noise, level) for noise in NOISES for level in LEVELS)]
    for length in LENGTHS:
        results = {case: measure(length, *case, seeds) for case in cases}
        for place, labels in enumerate(LABELS):
            table = [
                [noise if level else "none", level]
                + [interval([error[place] for error in column], 3) for column in errors.values()]
                for (noise, level), errors in results.items()
            ]
            head = [f"{length} frames, {labels:,} labels: noise", "level"]
            tables.append(([*head, *next(iter(results.values()))], table))
    save(
        "dots",
        "A moving dot in noise",
        "Root mean square error, in image widths, of a dot's position on images of 28x28 pixels, "
        "predicted by ridge regression from features of one image. Dot and noise are those of the "
        "code of Sobal et al. 2022, without its CIFAR-10 images. Noise changes with each image, is "
        "fixed within a trajectory, or turns slowly from one random image into another; the level "
        f"is its brightness relative to the dot's. {FRAMES:,} images each to learn features, to "
        "take labels from, and to judge. `within`: learned from images without the mean of their "
        f"trajectory, applied to them as they are. Means and 95 % intervals of {seeds} seeds.",
        tables,
    )
