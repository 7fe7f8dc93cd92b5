"""How late the images of a camera are, against the joint states that they show."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np

from cdmisfa.core.arrays import FloatArray
from replay.episodes.measure import Measured, period
from replay.episodes.numbers import Column, column, paths, scaled

# Largest lag that is looked for, in seconds.
SPAN: Final = 0.75

# Seconds between two images and states whose differences are compared: they change faster than
# these themselves, so that a lag is found more exactly.
STEP: Final = 0.2

# Largest number of images that are compared with states: their memory is 3 kB each.
MOST_IMAGES: Final = 30_000

# Weight of the penalty of ridge regression, in images.
RIDGE: Final = 10.0

# Parts of an episode, or of all episodes, that are left out in turn to find the uncertainty.
PARTS: Final = 10

# Least correlation of a joint, over the largest one of all, for the lag of all together.
VISIBLE: Final = 0.8

# A lag is measured from this correlation on, in itself and in its standard errors, this much above
# the second peak, and up to this standard error in frames, of an episode with at least this share
# of the typical motion. Set on simulated arms and moving squares.
CORRELATION: Final = 0.3
CERTAIN: Final = 5.0
MARGIN: Final = 0.03
ERROR: Final = 1.0
MOTION: Final = 0.3

# The same for all episodes together, whose joints need not be those that the camera shows: five
# good episodes of a simulated arm had a peak that was wrong by 0.6 s, 0.10 above the second.
MARGIN_OF_ALL: Final = 0.15

# Least number of episodes whose scatter limits the errors of their lags.
SCATTER: Final = 8

# Standard errors by which the lag of an episode is off the one of all episodes to be reported.
CERTAIN_AWAY: Final = 2.5


class Lag(NamedTuple):
    """A lag of a camera behind the joints.

    Attributes:
        seconds: time from a joint state to the image that shows it.
        error: its standard error (s).
        margin: how much higher the correlation is there than at the second peak.
        curve: (lags,) correlation at each lag, the most negative one first.
        clear: whether the peak is high enough.
        steady: whether it is clear, and its correlation far from 0 in standard errors.
        certain: whether it is steady, and its error small enough.
    """

    seconds: float
    error: float
    margin: float
    curve: FloatArray
    clear: bool
    steady: bool
    certain: bool


def lag_column(
    episodes: Sequence[Measured], camera: str, features: Sequence[FloatArray]
) -> tuple[Column, list[Lag], Lag] | None:
    """Return how late a camera is in each episode, and in all together; None without states.

    c(l) = correlation of f(t) W with s(t - l), f and s the changes of features and states in
        0.2 s, W by ridge regression: for one episode to s at the lag of all episodes, for
        all together at each l, to other parts of them than it predicts
    lag = c(largest) - c(median lag of all episodes), 0 within a frame of it

    Equation: E14
    """
    numbers = scaled(episodes, "state")
    if numbers is None:
        return None
    clocks = [episode.cameras[camera].times for episode in episodes]
    frame = float(np.median([period(times) for times in clocks])) or 1.0
    span, step = max(int(SPAN / frame), 1), max(round(STEP / frame), 1)
    thin = -(-sum(map(len, clocks)) // MOST_IMAGES)
    late = np.arange(-span, span + 1, dtype=np.float64) * frame
    changes = [
        _changes(times, rows, clock, x, late, step, thin)
        for times, rows, (clock, x) in zip(clocks, features, numbers, strict=True)
    ]
    if sum(len(f) for f, _ in changes) <= 4 * span:
        return None
    whole = _peak(_predicted(changes), frame)
    whole = whole._replace(certain=whole.certain and whole.margin >= MARGIN_OF_ALL)
    lags = [whole]
    if len(episodes) > 1:
        middle = span + (round(whole.seconds / frame) if whole.certain else 0)
        length = np.array([path[-1] for path in paths(numbers)[0]])
        lags = [_peak(sums, frame) for sums in _fitted(changes, middle)]
        for i in np.flatnonzero(length < MOTION * np.median(length)):
            lags[i] = lags[i]._replace(clear=False, steady=False, certain=False)
        lags = _within_scatter(lags, frame)
    clear = [lag.seconds for lag in lags if lag.clear]
    typical = float(np.median(clear)) if clear else 0.0
    away = np.array([abs(lag.seconds - typical) for lag in lags])
    apart = away > [max(1.5 * frame, CERTAIN_AWAY * lag.error) for lag in lags]
    apart &= [lag.clear for lag in lags]
    gain = [lag.curve.max() - lag.curve[round(typical / frame) + span] for lag in lags]
    # A clear peak that is uncertain by itself confirms the lag of all within a frame of it.
    for place, lag in enumerate(lags):
        distance = abs(lag.seconds - whole.seconds)
        if whole.certain and lag.clear and not (lag.certain or apart[place]) and distance <= frame:
            error = max(whole.error, distance)
            lags[place] = lag._replace(seconds=whole.seconds, error=error, certain=True)
    certain = apart | [lag.certain for lag in lags]
    seconds = [lag.seconds for lag in lags]
    return column("lag", apart * gain, np.where(certain, seconds, np.nan)), lags, whole


def _changes(
    times: FloatArray,
    f: FloatArray,
    clock: FloatArray,
    x: FloatArray,
    late: FloatArray,
    step: int,
    thin: int,
) -> tuple[FloatArray, FloatArray]:
    """Return the changes of features, (T, 16), and of states at each lag, (T, lags, n).

    Images without a state at some lag, near the begin and the end, are left out.
    """
    begin = np.arange(0, len(times) - step, thin)
    inside = times[begin] - late[-1] >= clock[0]
    inside &= times[begin + step] - late[0] <= clock[-1]
    begin = begin[inside]
    after, before = (
        np.stack([np.interp(times[rows][:, None] - late, clock, column) for column in x.T], axis=-1)
        for rows in (begin + step, begin)
    )
    return f[begin + step] - f[begin], after - before


def _ridge(gram: FloatArray, product: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.solve(gram + RIDGE * np.eye(len(gram)), product))


def _predicted(changes: Sequence[tuple[FloatArray, FloatArray]]) -> FloatArray:
    """Return sums (parts, lags, 3) of products of states and estimates from images of other parts.

    The three are estimate x state, estimate x estimate, and state x state, over the joints that
    images show well: of the others the lag is not right.
    """
    many = max(-(-PARTS // len(changes)), 1)
    parts = [
        (f[rows], s[rows])
        for f, s in changes
        for rows in np.array_split(np.arange(len(f)), many)
        if len(rows)
    ]
    grams = np.stack([f.T @ f for f, _ in parts])
    products = np.stack([np.einsum("ti,tln->lin", f, s, optimize=True) for f, s in parts])
    gram, product, sums = grams.sum(0), products.sum(0), []
    for (f, s), part_gram, part_product in zip(parts, grams, products, strict=True):
        weights = _ridge(gram - part_gram, product - part_product)
        estimate = np.einsum("ti,lin->tln", f, weights, optimize=True)
        sums.append(np.stack([_sums(estimate[..., [j]], s[..., [j]]) for j in range(s.shape[2])]))
    of_joints = np.stack(sums)
    visible = np.array([_correlation(joint).max() for joint in of_joints.sum(0)])
    return np.asarray(of_joints[:, visible >= VISIBLE * visible.max()].sum(1))


def _fitted(changes: Sequence[tuple[FloatArray, FloatArray]], middle: int) -> Iterator[FloatArray]:
    """Yield for each episode sums (parts, lags, 3) as `_predicted`, of one regression for all.

    The worst fifth of the images is left out of the regression: a frozen camera tells nothing.
    """
    a = np.concatenate([f for f, _ in changes])
    b = np.concatenate([s[:, middle] for _, s in changes])
    good = np.ones(len(a), bool)
    for _ in range(2):
        weights = _ridge(a[good].T @ a[good], a[good].T @ b[good])
        error = (b - a @ weights) ** 2
        good = error.mean(1) <= np.quantile(error.mean(1), 0.8)
    unit = 1 / np.sqrt(error[good].mean(0) + 0.05 * b.var(0) + 1e-9)
    for f, s in changes:
        estimate = f @ weights * unit
        rows = np.array_split(np.arange(len(f)), PARTS)
        yield np.stack([_sums(estimate[part][:, None], s[part] * unit) for part in rows])


def _sums(estimate: FloatArray, s: FloatArray) -> FloatArray:
    pairs = (estimate, s), (estimate, estimate), (s, s)
    return np.stack([np.broadcast_to((a * b).sum((0, 2)), s.shape[1]) for a, b in pairs], axis=-1)


def _peak(sums: FloatArray, frame: float) -> Lag:
    """Return the lag at the highest correlation; its error by leaving out each part (jackknife)."""
    curves = np.stack([_correlation(sums.sum(0) - part) for part in [0 * sums[0], *sums]])
    curve, best = curves[0], int(curves[0].argmax())
    places = np.array([_place(part) for part in curves])
    error = _jackknife(places[1:])
    edges = np.concatenate([[-np.inf], curve, [-np.inf]])
    tops = (edges[1:-1] >= edges[:-2]) & (edges[1:-1] > edges[2:])
    tops[best] = False
    margin = curve[best] - max(curve[tops].max(initial=curve.min()), 0)
    inside = 0 < best < len(curve) - 1
    clear = bool(inside and margin >= MARGIN and curve[best] >= CORRELATION)
    steady = clear and bool(curve[best] >= CERTAIN * _jackknife(curves[1:, best]))
    seconds = float(places[0] - len(curve) // 2) * frame
    certain = steady and error <= ERROR
    return Lag(seconds, max(error, 0.5) * frame, float(margin), curve, clear, steady, certain)


def _within_scatter(lags: Sequence[Lag], frame: float) -> list[Lag]:
    """Return the lags of episodes with errors that fit their scatter.

    The error of the place of a maximum is overestimated by leaving out parts: the few parts in
    which most of the motion is decide it. All errors are scaled alike, and never up.
    """
    clear = [lag for lag in lags if lag.clear]
    if len(clear) < SCATTER:
        return [*lags]
    places = np.array([lag.seconds for lag in clear])
    scatter = 1.4826 * float(np.median(np.abs(places - np.median(places))))
    share = min(scatter / float(np.median([lag.error for lag in clear])), 1.0)
    errors = [max(lag.error * share, frame / 2) for lag in lags]
    return [
        lag._replace(error=error, certain=lag.steady and error <= ERROR * frame)
        for lag, error in zip(lags, errors, strict=True)
    ]


def _jackknife(values: FloatArray) -> float:
    """Return the standard error of a value from its values without each of the parts."""
    n = len(values)
    return float(np.sqrt((n - 1) / n * ((values - values.mean()) ** 2).sum()))


def _correlation(sums: FloatArray) -> FloatArray:
    return np.asarray(sums[:, 0] / np.sqrt(sums[:, 1] * sums[:, 2] + 1e-18))


def _place(curve: FloatArray) -> float:
    """Return where a curve is highest: the vertex of the parabola through three values."""
    best = int(curve.argmax())
    if not 0 < best < len(curve) - 1:
        return float(best)
    a, b, c = curve[best - 1 : best + 2]
    return best + float((a - c) / (2 * (a - 2 * b + c) - 1e-12))
