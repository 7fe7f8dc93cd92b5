"""Recursive SFA: what batch SFA finds, in blocks, whatever the input's rank, type and cut."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from numpy.typing import NDArray

from cdmisfa.features.recursive import RecursiveFeature
from cdmisfa.features.sfa import batch_sfa
from cdmisfa.kernels import ffi, lib

FOREVER = 10**9


def direction_cosine(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(a @ b / np.sqrt((a @ a) * (b @ b)))


def mixture(seed: int, n: int, sources: int, inputs: int) -> NDArray[np.float64]:
    """A few sources from slow to fast, seen through a random matrix."""
    rng = np.random.default_rng(seed)
    t = np.arange(n)[:, None]
    periods = 2.0 * np.pi / (90.0 / 2.3 ** np.arange(sources))
    waves = np.sin(t * periods + rng.uniform(0, 6, sources)) + 0.1 * rng.normal(size=(n, sources))
    return waves @ rng.normal(size=(sources, inputs)) + rng.normal(size=inputs)


def learned(frames: NDArray[Any], cuts: list[int], **options: Any) -> RecursiveFeature:
    sfa = RecursiveFeature(frames.shape[1], window=FOREVER, **options)
    for i, piece in enumerate(np.split(frames, cuts)):
        sfa.update(piece, gap=i == 0)
    return sfa


@given(
    seed=st.integers(0, 10**6),
    sources=st.integers(1, 6),
    block=st.integers(2, 150),
    scale=st.sampled_from([1e-4, 1.0, 1e4]),
)
@settings(max_examples=25)
def test_equals_batch_sfa_over_an_infinite_window(
    seed: int, sources: int, block: int, scale: float
) -> None:
    frames = mixture(seed, 3000, sources, 20) * scale
    outputs = min(2, sources)
    sfa = learned(frames, list(range(block, 3000, block)), components=6, outputs=outputs)
    for own, batch in zip(sfa.phi, batch_sfa(frames, outputs), strict=True):
        assert abs(direction_cosine(own, batch)) > 1 - 1e-6
    y = (frames - sfa.mean) @ sfa.phi.T
    assert y.var(axis=0) == pytest.approx(1.0, rel=1e-6)


@given(seed=st.integers(0, 10**6), cuts=st.lists(st.integers(1, 999), max_size=8, unique=True))
@settings(max_examples=25)
def test_it_does_not_matter_how_frames_of_few_directions_are_cut(
    seed: int, cuts: list[int]
) -> None:
    frames = mixture(seed, 1000, 4, 12)
    whole = learned(frames, [], components=4)
    pieces = learned(frames, sorted(cuts), components=4)
    assert abs(direction_cosine(whole.phi[0], pieces.phi[0])) > 1 - 1e-9
    assert pieces.state.spectrum == pytest.approx(whole.state.spectrum, rel=1e-6)


def test_differences_over_a_gap_do_not_count() -> None:
    a, b = mixture(3, 700, 3, 10), mixture(3, 700, 3, 10)[::-1] + 5.0
    sfa = RecursiveFeature(10, 5, window=FOREVER)
    sfa.update(a)
    sfa.update(b, gap=True)
    steps = np.concatenate([np.diff(a, axis=0), np.diff(b, axis=0)])
    both = np.concatenate([a, b])
    y_steps, y = steps @ sfa.phi[0], (both - both.mean(axis=0)) @ sfa.phi[0]
    expected = np.sqrt((y_steps**2).mean() / y.var()) / (2 * np.pi)
    # The parts differ along a direction of no steps: slowness 0, of which rounding has the root.
    assert sfa.slowness == pytest.approx(expected, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("value", [0, 93])
@pytest.mark.parametrize("dtype", [np.uint8, np.float64])
def test_a_stream_that_shows_nothing_has_no_slow_feature(value: int, dtype: Any) -> None:
    sfa = RecursiveFeature(40, 5)
    for _ in range(4):
        change = sfa.update(np.full((30, 40), value, dtype))
        assert np.isnan(change).all()
    assert np.isnan(sfa.slowness)
    assert not sfa.phi.any()
    sfa.update(np.random.default_rng(0).integers(0, 256, (60, 40)).astype(dtype))
    assert np.isfinite(sfa.slowness)  # it comes to life as soon as something moves


@given(rank=st.integers(1, 9), n=st.integers(1, 70), seed=st.integers(0, 1000))
@settings(max_examples=40)
def test_any_rank_and_any_block_length(rank: int, n: int, seed: int) -> None:
    frames = mixture(seed, 4 * n + 12, rank, 9)
    sfa = RecursiveFeature(9, 16, outputs=3)
    for start in range(0, len(frames), n):
        sfa.update(frames[start : start + n])
    remaining = sfa.state.counts[0]
    assert remaining <= rank
    basis = sfa.state.basis[:remaining]
    assert np.allclose(basis @ basis.T, np.eye(remaining), atol=1e-6)
    assert np.isfinite(sfa.phi).all()


def test_other_outputs_are_judged_without_frames() -> None:
    frames = mixture(6, 3000, 4, 15)
    sfa = learned(frames, [700, 2100], components=8)
    y = (frames - frames.mean(axis=0)) @ sfa.phi.T
    for phi in np.random.default_rng(1).normal(size=(3, 15)):
        other = (frames - frames.mean(axis=0)) @ phi
        steps = (np.diff(other) ** 2).mean()
        variance, slowness, rho = sfa.compare(phi)
        assert variance == pytest.approx(other.var(), rel=1e-6)
        assert slowness == pytest.approx(np.sqrt(steps / other.var()) / (2 * np.pi), rel=1e-6)
        assert rho == pytest.approx(abs(np.corrcoef(y[:, 0], other)[0, 1]), abs=1e-6)
    assert sfa.compare(sfa.phi[0]) == pytest.approx((1.0, sfa.slowness, 1.0))


def test_what_lies_outside_of_the_directions_kept_counts_as_its_last_frames_show_it() -> None:
    rng = np.random.default_rng(9)
    frames = mixture(9, 3000, 2, 40) + 0.6 * rng.normal(size=(3000, 40))
    sfa = learned(frames, list(range(40, 3000, 40)), components=2)
    phi = sfa.phi[0] + 0.3 * rng.normal(size=40)
    y = (frames - frames.mean(axis=0)) @ phi
    truth = np.sqrt((np.diff(y) ** 2).mean() / y.var()) / (2 * np.pi)
    assert sfa.compare(phi).slowness < 0.8 * truth
    whole = sfa.compare(phi, frames[-400:])
    assert whole.slowness == pytest.approx(truth, rel=0.1)
    assert whole.variance == pytest.approx(y.var(), rel=0.2)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda sfa: pickle.loads(pickle.dumps(sfa))])
def test_a_copy_learns_on_its_own(copied: Callable[[RecursiveFeature], RecursiveFeature]) -> None:
    frames = np.random.default_rng(3).integers(0, 256, (400, 60), dtype=np.uint8)
    sfa = learned(frames[:200], [], components=8)
    other, phi = copied(sfa), sfa.phi
    other.update(frames[200:])
    np.testing.assert_array_equal(sfa.phi, phi)
    sfa.update(frames[200:])
    np.testing.assert_array_equal(sfa.phi, other.phi)


@given(n=st.integers(0, 40), seed=st.integers(0, 10**6), kind=st.integers(0, 4))
@settings(max_examples=60)
def test_eigenvectors(n: int, seed: int, kind: int) -> None:
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(n, n))
    matrix = [
        a + a.T,
        a @ a.T,
        np.diag(10.0 ** rng.integers(-15, 15, n)),
        np.ones((n, n)),
        np.zeros((n, n)),
    ][kind]
    values, vectors = np.empty(n), np.empty((n, n))
    arrays = (matrix.copy(), values, vectors, np.empty(3 * n))
    lib.eigen(n, *(ffi.from_buffer("double[]", array) for array in arrays))
    size = max(np.abs(matrix).max(initial=0.0), 1e-300)
    assert values / size == pytest.approx(np.linalg.eigvalsh(matrix)[::-1] / size, abs=1e-12)
    assert vectors @ vectors.T == pytest.approx(np.eye(n), abs=1e-12)
    assert vectors @ matrix @ vectors.T / size == pytest.approx(np.diag(values) / size, abs=1e-12)
