"""Results of a sweep: mean and standard deviation over seeds at each point of its grid."""

from __future__ import annotations

import csv
import io
import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
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

# 97.5 % quantiles of Student's t distribution, for 1 to 30 degrees of freedom.
STUDENT_95 = (
    12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228,
    2.201, 2.179, 2.160, 2.145, 2.131, 2.120, 2.110, 2.101, 2.093, 2.086,
    2.080, 2.074, 2.069, 2.064, 2.060, 2.056, 2.052, 2.048, 2.045, 2.042,
)  # fmt: skip

# Range of the slope of a logistic fit, divided by the range of x. Set by hand, far beyond the
# slopes of the trials: a step is steepest, a line across the range is flattest.
MAX_SLOPE = 1e4
MIN_SLOPE = 1e-2


@dataclass(frozen=True, slots=True)
class MeanSd:
    """Mean and standard deviation (n - 1) of n values; NaN if there are too few values."""

    mean: float
    sd: float
    n: int


def summary(values: ArrayLike) -> MeanSd:
    """Return mean and standard deviation of the values that are finite.

    Example:
        >>> summary([1.0, 3.0, float("nan")])
        MeanSd(mean=2.0, sd=1.4142135623730951, n=2)
    """
    x = np.asarray(values, dtype=float).ravel()
    x = x[np.isfinite(x)]
    if not len(x):
        return MeanSd(math.nan, math.nan, 0)
    return MeanSd(float(x.mean()), float(x.std(ddof=1)) if len(x) > 1 else math.nan, len(x))


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
    sample = summary(values)
    if sample.n < 2:
        return -math.inf, math.inf
    freedom = sample.n - 1
    # First terms of the expansion of the quantile for many degrees of freedom.
    approximate = NORMAL_95 + (NORMAL_95**3 + NORMAL_95) / (4 * freedom)
    t = STUDENT_95[freedom - 1] if freedom <= len(STUDENT_95) else approximate
    half = t * sample.sd / math.sqrt(sample.n)
    return sample.mean - half, sample.mean + half


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
        measures: mean and standard deviation over the finished trials, by name.
        orders: number of trials that learned the streams in each order, the most frequent first.
    """

    point: Mapping[str, Any]
    trials: int
    done: int
    failed: int
    missing: int
    measures: Mapping[str, MeanSd]
    orders: Mapping[str, int]


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
    return PointResult(point, *counts, measures, dict(orders.most_common()))


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
    """Return a CSV table: a line for each point, and two columns for each measure."""
    measures, text = _measures(points), io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    columns = [f"{name}_{part}" for name in measures for part in ("mean", "sd")]
    keys = list(points[0].point) if points else []
    writer.writerow([*keys, "trials", "done", "failed", *columns, "order", "order_count"])
    for p, *at_point in zip(points, *measures.values(), strict=True):
        numbers = [value for measure in at_point for value in (measure.mean, measure.sd)]
        cells = ["" if math.isnan(value) else repr(value) for value in numbers]
        order = next(iter(p.orders.items()), ("", 0))
        writer.writerow([*p.point.values(), p.trials, p.done, p.failed, *cells, *order])
    return text.getvalue()


def as_table(points: Sequence[PointResult]) -> tuple[list[str], list[list[str]]]:
    """Return head and rows of a table: mean ± SD, and the most frequent order with its count."""
    measures = _measures(points)
    head = [*(points[0].point if points else ()), "done", "failed", *measures, "order"]
    rows = []
    for p, *at_point in zip(points, *measures.values(), strict=True):
        order, count = next(iter(p.orders.items()), ("", 0))
        share = f"{order} ({count}/{p.done})" if order else ""
        cells = [_cell(measure) for measure in at_point]
        done = f"{p.done}/{p.trials}"
        rows.append([*map(str, p.point.values()), done, str(p.failed), *cells, share])
    return head, rows


def _cell(measure: MeanSd) -> str:
    if not measure.n:
        return ""
    mean, sd = f"{measure.mean:.4g}", f" ± {measure.sd:.2g}"
    return mean if math.isnan(measure.sd) else mean + sd
