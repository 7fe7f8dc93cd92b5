"""Results of a sweep: mean, standard deviation and 95 % interval at each point of its grid."""

from __future__ import annotations

import csv
import io
import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.errors import LogDamagedError
from cdmisfa.experiments.store import DONE, FAILED, ROWS, read_trial_rows
from replay.runs.folders import read_request

# 95 % quantile of the chi-square distribution with one degree of freedom.
CHI_SQUARE_95 = 3.841458820694124

# 97.5 % quantile of the normal distribution: 95 % of its values are within this of the mean.
NORMAL_95 = 1.959963984540054

# Range of the slope of a logistic fit, divided by the range of x. Set by hand, far beyond the
# slopes of the trials: a step is steepest, a line across the range is flattest.
MAX_SLOPE = 1e4
MIN_SLOPE = 1e-2


@dataclass(frozen=True, slots=True)
class MeanSd:
    """Mean and standard deviation (n - 1) of n values; NaN if there are too few values.

    `interval` is the 95 % interval of the mean (Student); None for fewer than two values.
    """

    mean: float
    sd: float
    n: int
    interval: tuple[float, float] | None = None


def summary(values: ArrayLike) -> MeanSd:
    """Return mean, standard deviation and interval of the values that are finite.

    Example:
        >>> result = summary([1.0, 3.0, float("nan")])
        >>> result.mean, round(result.sd, 3), [round(bound, 3) for bound in result.interval]
        (2.0, 1.414, [-10.706, 14.706])
    """
    x = np.asarray(values, dtype=float).ravel()
    x = x[np.isfinite(x)]
    if len(x) < 2:
        return MeanSd(float(x[0]) if len(x) else math.nan, math.nan, len(x))
    mean, sd = float(x.mean()), float(x.std(ddof=1))
    half = student(len(x) - 1) * sd / math.sqrt(len(x))
    return MeanSd(mean, sd, len(x), (mean - half, mean + half))


@cache
def student(freedom: int) -> float:
    """Return the 97.5 % quantile of Student's t distribution with some degrees of freedom.

    It inverts the finite series of the probability that |t| is below tan(angle) sqrt(freedom)
    (Abramowitz and Stegun, 26.7.3 and 26.7.4).

    Example:
        >>> [round(student(freedom), 3) for freedom in (1, 2, 10)]
        [12.706, 4.303, 2.228]
    """
    odd = freedom % 2
    k = np.arange(2 + odd, freedom, 2)
    low, high = 0.0, math.pi / 2
    while low < (angle := (low + high) / 2) < high:
        sine, cosine = math.sin(angle), math.cos(angle)
        series = 1 + float(np.cumprod((k - 1) / k * cosine**2).sum())
        wave = sine * (cosine if odd else 1) * series * (freedom > 1)
        inside = (angle + wave) * 2 / math.pi if odd else wave
        low, high = (angle, high) if inside < 0.95 else (low, angle)
    return math.tan(low) * math.sqrt(freedom)


def wilson(successes: int, n: int) -> tuple[float, float]:
    """Return the 95 % interval of a proportion, within [0, 1] (Wilson 1927).

    Example:
        >>> [round(bound, 3) for bound in wilson(20, 20)]
        [0.839, 1.0]
    """
    if n == 0:
        return 0.0, 1.0
    share, z = successes / n, NORMAL_95
    centre = (share + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(share * (1 - share) / n + z * z / (4 * n * n))
    return max(0.0, centre - half), min(1.0, centre + half)


def mean_interval(values: ArrayLike) -> tuple[float, float]:
    """Return the 95 % interval of the mean of values (Student); infinite for one value.

    Example:
        >>> [round(bound, 2) for bound in mean_interval([1.0, 2.0, 3.0])]
        [-0.48, 4.48]
    """
    return summary(values).interval or (-math.inf, math.inf)


def logistic_midpoint(x: ArrayLike, yes: ArrayLike) -> float:
    """Fit P(yes) = 1 / (1 + exp(-k (x - m))), k > 0, and return m.

    The likelihood is penalised with Jeffreys' prior (Firth 1993), so that the fit is finite even if
    one x separates all answers.

    Args:
        x: (n,) positions of the answers.
        yes: (n,) the answers, True or False.

    Returns:
        The midpoint m; NaN if all answers are the same, or all positions are.
    """
    at, answer = np.asarray(x, dtype=float), np.asarray(yes, dtype=float)
    levels, inverse = np.unique(at, return_inverse=True)
    if len(levels) < 2 or answer.min() == answer.max():
        return math.nan
    total: FloatArray = np.bincount(inverse).astype(np.float64)
    hits = np.asarray(np.bincount(inverse, weights=answer), dtype=np.float64)
    span = float(levels[-1] - levels[0])
    slopes = np.geomspace(MIN_SLOPE / span, MAX_SLOPE / span, 61)
    low, high = float(levels[0] - 2 * span), float(levels[-1] + 2 * span)
    for _ in range(4):  # search a finer grid each time, in the 95 % profile likelihood interval
        m = np.linspace(low, high, 121)
        heights = _log_likelihood(levels, hits, total, m, slopes)
        profile = heights.max(axis=1)
        top = int(np.argmax(profile))
        inside = np.flatnonzero(profile > profile[top] - CHI_SQUARE_95 / 2)
        low, high = m[max(inside[0] - 1, 0)], m[min(inside[-1] + 1, len(m) - 1)]
        likely = np.flatnonzero(heights[inside].max(axis=0) > profile[top] - CHI_SQUARE_95)
        slopes = np.geomspace(
            slopes[max(likely[0] - 1, 0)], slopes[min(likely[-1] + 1, len(slopes) - 1)], 61
        )
    return float(m[top])


def _log_likelihood(
    x: FloatArray, hits: FloatArray, total: FloatArray, m: FloatArray, k: FloatArray
) -> FloatArray:
    """Return (M, K) the log likelihood plus half the log determinant of the information.

    Args:
        x: (L,) levels of x.
        hits: (L,) number of yes answers at each level.
        total: (L,) number of answers at each level.
        m: (M,) midpoints.
        k: (K,) slopes.
    """
    u = x - m[:, None, None]
    z = np.clip(k[:, None] * u, -700.0, 700.0)
    softplus = np.logaddexp(0.0, z)
    likelihood = (hits * z - total * softplus).sum(axis=-1)
    w = total * np.exp(z - 2 * softplus)
    determinant = w.sum(-1) * (w * u * u).sum(-1) - (w * u).sum(-1) ** 2
    return np.asarray(likelihood + 0.5 * np.log(np.maximum(determinant, 1e-300)))


def correlation(a: FloatArray, b: FloatArray) -> float:
    """Return the absolute Pearson correlation of two series (n,); 0 if one is constant."""
    if a.max() == a.min() or b.max() == b.min():
        return 0.0
    return abs(float(np.corrcoef(a, b)[0, 1]))


@dataclass(frozen=True, slots=True)
class PointResult:
    """Results at one point of the grid.

    Attributes:
        point: the values of the point, by configuration key.
        trials: number of requested trials.
        done: number of finished trials, which the measures describe.
        failed: number of failed trials.
        missing: number of trials that were not computed yet.
        measures: mean, standard deviation and interval over the finished trials, by name.
        orders: number of trials that learned the streams in each order, the most frequent first.
        shares: 95 % interval of the share of the finished trials with each order (Wilson).
    """

    point: Mapping[str, Any]
    trials: int
    done: int
    failed: int
    missing: int
    measures: Mapping[str, MeanSd]
    orders: Mapping[str, int]
    shares: Mapping[str, tuple[float, float]]


def results(folder: str | Path) -> list[PointResult]:
    """Return the points of a sweep as it was requested last, in the order of the grid.

    Raises:
        UsageError: the folder has no sweep.
        LogDamagedError: its files are damaged.
    """
    folder = Path(folder)
    trials = read_request(folder)
    rows = {row["id"]: row for row in read_trial_rows(folder)}
    points: dict[str, tuple[dict[str, Any], list[Any]]] = {}
    for number, point in trials:
        points.setdefault(json.dumps(point), (point, []))[1].append(rows.get(number))
    try:
        return [_point(point, of_point) for point, of_point in points.values()]
    except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        raise LogDamagedError(
            f"{folder / ROWS}: a row is not the result of a trial ({error}): remove the file and "
            "run the sweep again"
        ) from error


def _point(point: Mapping[str, Any], rows: Sequence[Mapping[str, Any] | None]) -> PointResult:
    finished = [row["result"] for row in rows if row is not None and row["status"] == DONE]
    measures = {
        "modules": summary([len(r["modules"]) for r in finished]),
        "iterations": summary([r["iterations"] for r in finished]),
    }
    for k in range(max((len(r["modules"]) for r in finished), default=0)):
        saved = [r["modules"][k] for r in finished if len(r["modules"]) > k]
        measures[f"iteration_{k + 1}"] = summary([m["iteration"] for m in saved])
        measures[f"eta_{k + 1}"] = summary([m["eta"][0] for m in saved])
    orders = Counter(" ".join(m["stream"] for m in r["modules"]) for r in finished)
    failed = sum(row is not None and row["status"] == FAILED for row in rows)
    counts = len(rows), len(finished), failed, rows.count(None)
    shares = {order: wilson(count, len(finished)) for order, count in orders.most_common()}
    return PointResult(point, *counts, measures, dict(orders.most_common()), shares)


def varied(points: Sequence[PointResult]) -> dict[str, list[Any]]:
    """Return the settings that differ between points, with their values in order."""
    keys = points[0].point if points else ()
    values = {key: list(dict.fromkeys(point.point[key] for point in points)) for key in keys}
    return {key: distinct for key, distinct in values.items() if len(distinct) > 1}


def as_json(points: Sequence[PointResult]) -> dict[str, Any]:
    """Return the results as a JSON document."""
    return {"schema": 1, "differ": varied(points), "points": [asdict(point) for point in points]}


def _measures(points: Sequence[PointResult]) -> dict[str, list[MeanSd]]:
    """Return the measures of all points by name; each is a list with one entry for each point."""
    names = dict.fromkeys(name for point in points for name in point.measures)
    return {name: [p.measures.get(name, summary([])) for p in points] for name in names}


def as_csv(points: Sequence[PointResult]) -> str:
    """Return a CSV table: a line for each point, and four columns for each measure."""
    measures, text = _measures(points), io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    columns = [f"{name}_{part}" for name in measures for part in ("mean", "sd", "low", "high")]
    keys = list(points[0].point) if points else []
    order_columns = "order", "order_count", "order_low", "order_high"
    writer.writerow([*keys, "trials", "done", "failed", *columns, *order_columns])
    for p, *at_point in zip(points, *measures.values(), strict=True):
        numbers = [v for m in at_point for v in (m.mean, m.sd, *(m.interval or (math.nan,) * 2))]
        cells = ["" if math.isnan(value) else repr(value) for value in numbers]
        order, count = next(iter(p.orders.items()), ("", 0))
        row = [p.trials, p.done, p.failed, *cells, order, count, *p.shares.get(order, ("", ""))]
        writer.writerow([*p.point.values(), *row])
    return text.getvalue()


def as_table(points: Sequence[PointResult]) -> tuple[list[str], list[list[str]]]:
    """Return head and rows of a table: mean ± SD with its interval, and the most frequent order."""
    measures = _measures(points)
    columns = [text for name in measures for text in (f"{name} ± SD", "95 %")]
    head = [*(points[0].point if points else ()), "done", "failed", *columns, "order", "95 %"]
    rows = []
    for p, *at_point in zip(points, *measures.values(), strict=True):
        order, count = next(iter(p.orders.items()), ("", 0))
        share = f"{order} ({count}/{p.done})" if order else ""
        cells = [cell for measure in at_point for cell in _cells(measure)]
        done, within = f"{p.done}/{p.trials}", _interval(p.shares.get(order) if order else None)
        rows.append([*map(str, p.point.values()), done, str(p.failed), *cells, share, within])
    return head, rows


def _cells(measure: MeanSd) -> tuple[str, str]:
    """Return mean ± SD, and the interval of the mean."""
    mean = f"{measure.mean:.4g}" if measure.n else ""
    spread = f" ± {measure.sd:.2g}" if measure.n > 1 else ""
    return mean + spread, _interval(measure.interval)


def _interval(bounds: tuple[float, float] | None) -> str:
    return " .. ".join(f"{bound:.4g}" for bound in bounds) if bounds else "-"
