"""Columns of image features: images unlike all other episodes, and the lag of a camera."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np

from cdmisfa.core.arrays import FloatArray
from cdmisfa.features.recursive import RecursiveFeature
from replay.episodes.measure import CameraMeasures, Measured, period
from replay.episodes.numbers import Column, column, paths, scaled

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

# Largest lag that is looked for, in seconds.
SPAN: Final = 0.75

# Seconds between two images and states whose differences are compared: they change faster than
# these themselves, so that a lag is found more exactly.
STEP: Final = 0.2

# Weight of the penalty of ridge regression, in images.
RIDGE: Final = 10.0

# Least motion, as a multiple of the median path of the joints, for which a lag can be told, and
# least correlation of the states with what the images tell of them.
MOTION: Final = 0.3
CORRELATION: Final = 0.4

# Frames beside the peak that belong to it, and the least margin to the largest value beyond.
PEAK: Final = 3
MARGIN: Final = 0.04

# Seconds after which joint states are independent of what they were.
INDEPENDENT: Final = 0.5


class Lag(NamedTuple):
    """How late the images of a camera are in all episodes together.

    Attributes:
        camera: the camera.
        seconds: time from a joint state to the image that shows it; NaN if it cannot be measured.
        error: its uncertainty (s).
        margin: how much more of the states images tell there than at the second peak.
    """

    camera: str
    seconds: float
    error: float
    margin: float


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


def lag_column(
    episodes: Sequence[Measured], camera: str, features: Sequence[FloatArray]
) -> tuple[Column, Lag] | None:
    """Return how late a camera is in each episode, and in all together; None without states.

    c(l) = correlation of f(t + l) W with s(t), the changes of features and states in 0.2 s
    lag = c(largest) - c(median lag of all episodes), 0 within a frame of it

    Equation: E14
    """
    numbers = scaled(episodes, "state")
    if numbers is None:
        return None
    cameras = [episode.cameras[camera] for episode in episodes]
    clocks = zip(cameras, numbers, strict=True)
    states = [np.stack([np.interp(c.times, t, v) for v in x.T], axis=1) for c, (t, x) in clocks]
    frame = float(np.median([period(c.times) for c in cameras])) or 1.0
    span, step = max(int(SPAN / frame), 1), max(round(STEP / frame), 1)
    features, states = ([x[step:] - x[:-step] for x in parts] for parts in (features, states))
    if max(map(len, states)) <= 2 * span + 2:
        return None
    whole = lag_curve(features, states, span)
    middle = int(whole.argmax()) - span
    curves = np.stack([*_correlations(features, states, middle, span)])
    peaks = curves.argmax(1)
    typical = int(np.median(peaks))
    length = np.array([path[-1] for path in paths(numbers)[0]])
    clear = np.array([margin(curve) for curve in curves]) > MARGIN
    sure = clear & (length > MOTION * np.median(length)) & (curves.max(1) > CORRELATION)
    late = np.where(sure, (peaks - span) * frame, np.nan)
    apart = sure & (np.abs(peaks - typical) > 1)
    gain = np.where(apart, curves.max(1) - curves[:, typical], 0.0)
    measured = sure.any() and margin(whole) > MARGIN
    seconds = middle * frame if measured else np.nan
    known = late[np.isfinite(late)]
    error = 1.4826 * float(np.median(np.abs(known - np.median(known)))) if measured else np.nan
    if len(known) < 3:  # the lags within a standard error of the largest value
        independent = max(sum(len(x) for x in states) * frame / INDEPENDENT, 2.0)
        least = whole.max() - (1 - whole.max()) / np.sqrt(independent)
        error = float((whole > least).sum()) * frame / 2
    error = max(error, frame / 2)
    return column("lag", gain, late), Lag(camera, seconds, error, margin(whole))


def lag_curve(
    features: Sequence[FloatArray], states: Sequence[FloatArray], span: int
) -> FloatArray:
    """Return the share of the states' variance that images tell, up to `span` frames late or early.

    r(l) = mean over joints of |f(t + l) W|^2 / |s(t)|^2, W by ridge regression at each l
    """
    long = [(f, s) for f, s in zip(features, states, strict=True) if len(f) > 2 * span + 2]
    a = np.concatenate([_with_one(f[span:-span]) for f, _ in long])
    center, curve = np.concatenate([s for _, s in long]).mean(0), []
    for late in range(-span, span + 1):
        b = np.concatenate([s[span - late : len(s) - span - late] for _, s in long]) - center
        product = a.T @ b
        known = (_ridge(a.T @ a, product) * product).sum(0)
        curve.append((known / ((b * b).sum(0) + 1e-9)).mean())
    return np.array(curve)


def _with_one(part: FloatArray) -> FloatArray:
    return np.concatenate([part, np.ones((len(part), 1))], axis=1)


def _ridge(gram: FloatArray, product: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.solve(gram + RIDGE * np.eye(len(gram)), product))


def _correlations(
    features: Sequence[FloatArray], states: Sequence[FloatArray], middle: int, span: int
) -> Iterator[FloatArray]:
    """Yield for each episode how states correlate with what images tell of them at each lag.

    The worst fifth of the images is left out of the regression: a frozen camera tells nothing.
    """
    low, high = max(middle, 0), max(-middle, 0)
    a = np.concatenate([_with_one(f[low : len(f) - high]) for f in features])
    b = np.concatenate([s[high : len(s) - low] for s in states])
    center, good = b.mean(0), np.ones(len(a), bool)
    for _ in range(2):
        weights = _ridge(a[good].T @ a[good], a[good].T @ (b[good] - center))
        error = (b - center - a @ weights) ** 2
        good = error.mean(1) <= np.quantile(error.mean(1), 0.8)
    unit = 1 / np.sqrt(error[good].mean(0) + 0.05 * b.var(0) + 1e-9)
    for feature, state in zip(features, states, strict=True):
        estimate, values = _with_one(feature) @ weights * unit, []
        if len(estimate) <= 2 * span + 2:
            yield np.zeros(2 * span + 1)
            continue
        for late in range(-span, span + 1):
            p = estimate[max(late, 0) : len(estimate) + min(late, 0)]
            s = state[max(-late, 0) : len(state) - max(late, 0)] * unit
            p, s = p - p.mean(0), s - s.mean(0)
            norm = np.sqrt((p * p).sum() * (s * s).sum()) + 1e-9
            values.append((p * s).sum() / norm)
        yield np.array(values)


def margin(curve: FloatArray) -> float:
    """Return how much higher a curve is at its largest value than beyond `PEAK` frames of it."""
    beyond = np.abs(np.arange(len(curve)) - curve.argmax()) > PEAK
    return float(curve.max() - curve[beyond].max()) if beyond.any() else 0.0
