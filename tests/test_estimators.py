"""Slow feature analysis in scikit-learn and river: their own checks, and more."""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from river import checks
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils.estimator_checks import check_estimator

import cdmisfa
from cdmisfa.core.errors import UsageError
from cdmisfa.estimators import IncSFA, OnlineSFA, RecursiveSFA
from cdmisfa.features.sfa import batch_sfa, slowness

Make = Callable[[], Any]
pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
BOTH = pytest.mark.parametrize("make", [RecursiveSFA, IncSFA])


def waves(n: int = 3000, size: int = 6) -> NDArray[np.float64]:
    """(n, size) mixed sines, from slow to quick."""
    t = np.arange(float(n))[:, None]
    mixing = np.linalg.qr(np.random.default_rng(3).standard_normal((size, size)))[0]
    return np.asarray(np.sin(t / (100.0 / 2.0 ** np.arange(size))) @ mixing + 5.0)


def correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return abs(float(np.corrcoef(a, b)[0, 1]))


@BOTH
def test_scikit_learns_own_checks_pass(make: Make) -> None:
    results = check_estimator(make(), on_skip=None, on_fail=None)
    wrong = {r["check_name"]: r["exception"] for r in results if r["status"] == "failed"}
    assert wrong == {}
    assert sum(r["status"] == "passed" for r in results) >= 40


@pytest.mark.parametrize("check", list(checks.yield_checks(OnlineSFA())), ids=lambda c: c.__name__)
def test_rivers_own_checks_pass(check: Callable[[Any], None]) -> None:
    check(OnlineSFA())


@pytest.mark.parametrize("cut", [1, 7, 1024, 3000])
def test_however_the_samples_are_cut_it_is_batch_sfa(cut: int) -> None:
    X, sfa = waves(), RecursiveSFA(3)
    for start in range(0, len(X), cut):
        sfa.partial_fit(X[start : start + cut])
    y, expected = sfa.transform(X), (X - X.mean(axis=0)) @ batch_sfa(X, 3).T
    assert [correlation(y[:, i], expected[:, i]) for i in range(3)] == pytest.approx([1.0] * 3)
    np.testing.assert_allclose(y.var(axis=0), 1.0, rtol=1e-6)
    np.testing.assert_allclose(sfa.slowness_, slowness(y), rtol=1e-3)
    assert sfa.n_samples_seen_ == len(X)


@BOTH
def test_nothing_is_learned_across_a_gap(make: Make) -> None:
    X = waves()
    a, b = np.array_split(X, 2)
    with_gaps, without = make().fit(a), make().fit(a)
    for _ in range(20):
        with_gaps.partial_fit(b[:50] + 30.0, gap=True)
        without.partial_fit(b[:50] + 30.0)
        with_gaps.partial_fit(a[:50], gap=True)
        without.partial_fit(a[:50])
    assert with_gaps.slowness_[0] < without.slowness_[0] / 2


@BOTH
@pytest.mark.parametrize("dtype", ["uint8", "int64", "float32", "bool", ">f8", "object"])
def test_numbers_of_any_type_count_as_they_are(make: Make, dtype: str) -> None:
    X = (waves(400) > 5.0) if dtype == "bool" else np.round(waves(400) * 4.0 + 60.0)
    own, plain = make().fit(X.astype(dtype)), make().fit(X.astype(float))
    np.testing.assert_array_equal(own.transform(X.astype(dtype)), plain.transform(X.astype(float)))
    np.testing.assert_array_equal(own.mean_, plain.mean_)


@BOTH
def test_it_learns_on_after_pickling_with_the_same_bits(make: Make) -> None:
    X = waves()
    straight = make().fit(X[:1000])
    copied = pickle.loads(pickle.dumps(straight))
    for sfa in (straight, copied):
        sfa.partial_fit(X[1000:])
    np.testing.assert_array_equal(straight.transform(X), copied.transform(X))
    again = clone(straight).fit(X[:1000]).partial_fit(X[1000:])
    np.testing.assert_array_equal(again.transform(X), straight.transform(X))
    np.testing.assert_array_equal(straight.fit(X[:500]).mean_, make().fit(X[:500]).mean_)


def test_inverse_transform_is_the_best_that_outputs_tell() -> None:
    X = waves()
    for n in (2, 6):
        sfa = RecursiveSFA(n).fit(X)
        y = sfa.transform(X)
        best = np.linalg.lstsq(y, X - X.mean(axis=0), rcond=None)[0]
        expected = y @ best + X.mean(axis=0)
        np.testing.assert_allclose(sfa.inverse_transform(y), expected, atol=1e-6)
    np.testing.assert_allclose(expected, X, atol=1e-6)


def test_incsfa_follows_what_is_slow() -> None:
    t = np.arange(30_000.0)
    slow, quick = np.sin(t / 50), np.sin(t)
    sfa = IncSFA(2, n_whitened=2).fit(np.stack([slow + quick, quick], axis=1)[:20_000])
    y = sfa.transform(np.stack([slow + quick, quick], axis=1)[20_000:])
    assert correlation(y[:, 0], slow[20_000:]) > 0.99
    np.testing.assert_allclose(sfa.slowness_, slowness(y), rtol=0.1)


def test_incsfa_warns_if_and_only_if_its_output_is_not_the_slowest_feature() -> None:
    found, t = [], np.arange(20_000.0)
    for seed in range(6):
        rng = np.random.default_rng(seed)
        slow = rng.standard_normal((len(t), 12))
        slow[:, 0] = np.sqrt(2) * np.sin(t / 200)
        rotated, mixing = np.linalg.qr(rng.standard_normal((12, 12)))[0], rng.standard_normal
        for X in (slow @ rotated, slow @ mixing((12, 12)), slow[:, 1:], waves(20_000, 3 + seed)):
            with warnings.catch_warnings(record=True) as warned:
                warnings.simplefilter("always", ConvergenceWarning)
                y = IncSFA().fit(X).transform(X)[:, 0]
            best = (X - X.mean(axis=0)) @ batch_sfa(X, 1)[0]
            found.append(correlation(y, best) >= 0.9 and slowness(y[:, None])[0] < 0.2)
            assert found[-1] != bool(warned), (seed, X.shape)
    assert 6 <= sum(found) <= 12
    with pytest.warns(ConvergenceWarning, match="slowest feature .* use RecursiveSFA"):
        IncSFA().fit(slow[:, 1:])
    for one in (slow[:, :1], slow[:, :2] * [1, 0], np.ones((9, 2))):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            IncSFA().fit(one)


@BOTH
@pytest.mark.parametrize(
    ("parameters", "X", "message"),
    [
        ({"n_components": 3}, np.ones((9, 2)), "n_components is 3.* at most 2"),
        ({"n_components": 5, "n_whitened": 4}, np.ones((9, 9)), "at most 4"),
        ({"n_components": 0}, np.ones((9, 2)), "n_components is 0: give a whole number"),
        ({"n_whitened": 2.5}, np.ones((9, 2)), "n_whitened is 2.5"),
        ({"window": None}, np.ones((9, 2)), "window is None"),
        ({}, np.full((9, 2), 1e200), "holds 1e[+]200, above the limit of 1e[+]100: scale it"),
        ({}, np.full((9, 2), np.nan), "contains NaN"),
        ({}, [[1.0, None]] * 9, "contains NaN"),
        ({}, np.zeros((9, 2), "M8[s]"), "X has type datetime64.s.: give times as numbers"),
    ],
)
def test_what_cannot_be_learned_is_refused(
    make: Callable[..., Any], parameters: dict[str, Any], X: Any, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        make(**parameters).fit(X)
    if not parameters and not np.array_equal(X, np.full((9, 2), 1e200)):
        with pytest.raises(ValueError, match=message):
            make().fit(waves(9, 2)).transform(X)


def samples(X: NDArray[np.float64]) -> list[dict[str, float]]:
    return [dict(zip("abcdef", row, strict=True)) for row in X.tolist()]


def test_a_sample_at_a_time_gives_the_same_bits() -> None:
    X, online, sfa = waves(300), OnlineSFA(2), RecursiveSFA(2)
    for row, x in zip(X, samples(X), strict=True):
        online.learn_one(x)
        sfa.partial_fit(row[None])
    y = sfa.transform(X[-1:])[0]
    assert list(online.transform_one(samples(X)[-1]).values()) == y.tolist()
    assert online.slowness == sfa.slowness_[0]


@pytest.mark.parametrize(
    "kind", [Decimal, Fraction, str, np.array, np.float32, lambda v: np.array(v, "f4")]
)
def test_samples_hold_any_type_of_number(kind: Callable[[float], Any]) -> None:
    online, plain = OnlineSFA(), OnlineSFA()
    for x in samples(np.round(waves(300), 2).astype(np.float32).astype(float)):
        online.learn_one({name: kind(value) for name, value in x.items()})
        plain.learn_one(x)
    assert online.slowness == plain.slowness > 0


@pytest.mark.parametrize("wrong", ["word", [1.0], 1j, 10**400, np.ma.masked])
def test_a_value_that_is_no_number_is_refused_by_its_name(wrong: Any) -> None:
    online = OnlineSFA()
    with pytest.raises(UsageError, match=r"^b(: some values are masked| is .*: give a number)"):
        online.learn_one({"a": 1.0, "b": wrong})


def test_masked_values_are_refused_everywhere_with_one_message() -> None:
    X = waves(400)
    module = cdmisfa.learn(waves(20_000)).modules[0]
    uses: list[Callable[[Any], Any]] = [
        RecursiveSFA().fit,
        IncSFA().partial_fit,
        RecursiveSFA().fit(X).transform,
        module.transform,
        cdmisfa.Recording,
        lambda x: cdmisfa.learn(x, max_iterations=2),
        lambda x: cdmisfa.learn({"a": X, "X": x}, max_iterations=2),
        lambda x: cdmisfa.learn(iter(x), max_iterations=2),
    ]
    masks = [np.arange(X.size).reshape(X.shape) == 7, np.ones_like(X, bool)]
    for use in uses:
        use(np.ma.array(X, mask=False))
        for mask in masks:
            for masked in (np.ma.array(X, mask=mask), list(np.ma.array(X, mask=mask))):
                with pytest.raises(ValueError, match="some values are masked: fill them"):
                    use(masked)


@pytest.mark.parametrize("lost", [None, float("nan"), float("inf"), 1e200])
def test_a_sample_that_lacks_something_is_a_gap(lost: Any) -> None:
    X, online, sfa = waves(300), OnlineSFA(), RecursiveSFA()
    incomplete = samples(X)[0] | {"a": lost} if lost else {"b": 1.0}
    for x in [*samples(X[:200]), incomplete, *samples(X[250:])]:
        online.learn_one(x)
    for i, row in enumerate(X):
        if not 200 <= i < 250:
            sfa.partial_fit(row[None], gap=i == 250)
    assert online.slowness == sfa.slowness_[0]
    centre = dict(zip("abcdef", sfa.mean_.tolist(), strict=True))
    assert online.transform_one({}) == online.transform_one(centre)
