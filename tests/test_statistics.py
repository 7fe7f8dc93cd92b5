"""Statistics with known answers."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cdmisfa.experiments import results as statistics

LEVELS = (1.0, 0.96, 0.93, 0.9, 0.86, 0.83, 0.8, 0.76, 0.73, 0.7, 0.6, 0.5, 0.3, 0.1)


def answers(
    midpoint: float, slope: float, seed: int, trials: int = 10
) -> tuple[list[float], list[bool]]:
    rng = np.random.default_rng(seed)
    x = np.repeat(LEVELS, trials)
    return x.tolist(), (rng.random(len(x)) < 1 / (1 + np.exp(-slope * (x - midpoint)))).tolist()


def test_two_levels_with_much_data_have_the_closed_form_fit() -> None:
    yes = [True] * 1000 + [False] * 9000 + [True] * 6000 + [False] * 4000
    fit = statistics.logistic_midpoint([0.0] * 10_000 + [1.0] * 10_000, yes)
    low, high = math.log(1 / 9), math.log(6 / 4)
    assert fit == pytest.approx(-low / (high - low), abs=1e-3)


@pytest.mark.parametrize(
    ("x", "yes"),
    [([0.2, 0.9], [False, False]), ([0.2, 0.9], [True, True]), ([0.5, 0.5], [False, True])],
)
def test_answers_that_do_not_change_have_no_midpoint(x: list[float], yes: list[bool]) -> None:
    assert math.isnan(statistics.logistic_midpoint(x, yes))


def test_wilson_interval_has_the_textbook_values() -> None:
    assert statistics.wilson(0, 10) == pytest.approx((0.0, 0.2775), abs=1e-4)
    assert statistics.wilson(5, 10) == pytest.approx((0.2366, 0.7634), abs=1e-4)
    assert statistics.wilson(0, 0) == (0.0, 1.0)


def test_correlation_has_known_answers() -> None:
    t = np.linspace(0, 2 * np.pi, 1000, endpoint=False)
    truth = np.stack([np.cos(t), -3 * np.sin(t) + 7, np.full(1000, 4.0), t], axis=1)
    r = [statistics.correlation(2 * np.sin(t) + 5, column) for column in truth.T]
    assert r[:3] == pytest.approx([0, 1, 0], abs=1e-12)
    assert r[3] == pytest.approx(abs(np.corrcoef(np.sin(t), t)[0, 1]))
    assert statistics.correlation(t, 3 - 2 * t) == pytest.approx(1.0)


def test_the_interval_of_a_mean_contains_it_in_95_percent_of_samples() -> None:
    rng = np.random.default_rng(0)
    for n in (3, 10, 40):
        bounds = np.array([statistics.mean_interval(rng.normal(2.0, 3.0, n)) for _ in range(4000)])
        inside = (bounds[:, 0] < 2.0) & (bounds[:, 1] > 2.0)
        assert inside.mean() == pytest.approx(0.95, abs=0.012)
    assert statistics.mean_interval([5.0, math.nan]) == (-math.inf, math.inf)
    assert statistics.mean_interval([1.0, 1.0]) == (1.0, 1.0)


@pytest.mark.parametrize(
    ("n", "t"),  # Student's t at 97.5 %, published tables
    [
        *((2, 12.7062), (3, 4.3027), (4, 3.1824), (5, 2.7764), (6, 2.5706), (10, 2.2622)),
        *((20, 2.0930), (30, 2.0452), (31, 2.0423), (41, 2.0211), (61, 2.0003), (100, 1.9842)),
    ],
)
def test_quantiles_of_student_are_those_of_published_tables(n: int, t: float) -> None:
    assert statistics.student(n - 1) == pytest.approx(t, abs=5.1e-5)


def test_quantiles_of_student_fall_to_that_of_the_normal_distribution() -> None:
    quantiles = [statistics.student(freedom) for freedom in (*range(1, 101), 10_001, 999_999)]
    assert all(np.diff(quantiles) < 0)
    assert quantiles[-1] == pytest.approx(statistics.NORMAL_95, abs=3e-6)
