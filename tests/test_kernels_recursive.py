"""Recursive SFA in C: what numpy comes to, on any processor, and nothing outside of its arrays."""

from __future__ import annotations

from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
from both_modules import using
from hypothesis import assume, given, settings
from numpy.typing import NDArray

from cdmisfa import kernels
from cdmisfa.core.errors import UsageError
from cdmisfa.features.recursive import RecursiveFeature, RecursiveState
from cdmisfa.kernels import _plain
from tests.reference import recursive as reference

GUARD = 8
"""Numbers before and behind every array that must stay what they were."""


@st.composite
def streams(draw: st.DrawFn) -> tuple[RecursiveFeature, list[NDArray[Any]], list[bool]]:
    """An SFA, blocks for it, and which of them follow a gap."""
    inputs = draw(st.one_of(st.integers(1, 40), st.integers(250, 530)))
    components = draw(st.integers(1, 20))
    outputs = draw(st.integers(1, min(components, 4)))
    lengths = draw(st.lists(st.integers(1, 140), min_size=1, max_size=5))
    sources = draw(st.integers(1, 60))
    rng = np.random.default_rng(draw(st.integers(0, 10**6)))
    t = np.arange(sum(lengths))[:, None]
    waves = np.sin(t * rng.uniform(0.01, 2.0, sources) + rng.uniform(0, 6, sources))
    x = waves @ rng.normal(size=(sources, inputs)) + rng.normal(size=inputs)
    if draw(st.booleans()):
        x = np.round(255 * (x - x.min()) / max(np.ptp(x), 1e-9)).astype(np.uint8)
    blocks = np.split(x, np.cumsum(lengths)[:-1])
    if draw(st.booleans()):
        blocks[draw(st.integers(0, len(blocks) - 1))][:] = x[0]
    gaps = [draw(st.booleans()) for _ in blocks]
    more = {"principal": draw(st.integers(0, min(components, 3))), "wide": draw(st.integers(0, 30))}
    sfa = RecursiveFeature(inputs, components, outputs, draw(st.integers(1, 400)), **more)
    if draw(st.booleans()):
        sfa.widen()
    return sfa, blocks, gaps


def copied(state: RecursiveState) -> RecursiveState:
    return RecursiveState(*(array.copy() for array in state))


def apart(values: NDArray[np.float64]) -> bool:
    """Whether eigenvalues differ enough for their eigenvectors to be certain."""
    return bool((np.abs(np.diff(values)) > 1e-5 * values.max(initial=0.0)).all())


def turned(own: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Signs with which the rows of one are those of the other, as a column."""
    return np.where((own * other).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)


@given(stream=streams())
@settings(max_examples=60)
def test_equals_the_reference(
    stream: tuple[RecursiveFeature, list[NDArray[Any]], list[bool]],
) -> None:
    sfa, blocks, gaps = stream
    for frames, gap in zip(blocks, gaps, strict=True):
        expected = copied(sfa.state)
        values = frames * (1 / 255) if frames.dtype == np.uint8 else frames
        more = sfa._wide if sfa.is_wide else 0, sfa._principal
        change = reference.update(expected, values, gap, sfa.window, *more)
        result = sfa.update(frames, gap)
        assert sfa.state.counts.tolist() == expected.counts.tolist()
        k = expected.counts[0]
        assert sfa.mean == pytest.approx(expected.mean, abs=1e-12)
        assert sfa.state.variance == pytest.approx(expected.variance, rel=1e-6)
        assert not sfa.state.variance[k:].any()
        assert not sfa.state.weights[:, k:].any()
        np.testing.assert_array_equal(sfa.state.last, values[-1])
        assume(apart(np.append(expected.variance[:k], 0.0)))
        signs = turned(sfa.state.basis[:k], expected.basis[:k])
        assert sfa.state.basis[:k] * signs == pytest.approx(expected.basis[:k], abs=1e-6)
        differences = sfa.state.differences[:k, :k] * signs * signs.T
        size = np.abs(differences).max(initial=0.0)
        assert differences == pytest.approx(expected.differences[:k, :k], abs=1e-6 * size)
        assert sfa.state.spectrum == pytest.approx(expected.spectrum, abs=1e-6, nan_ok=True)
        assume(apart(expected.spectrum[: min(k, len(expected.weights) + 1)] ** 2))
        weights = sfa.state.weights[:, :k] * signs.T
        size = np.abs(weights).max(initial=0.0)
        weights *= turned(weights, expected.weights[:, :k])
        assert weights == pytest.approx(expected.weights[:, :k], abs=1e-3 * size)
        assert result == pytest.approx(change, abs=1e-3, nan_ok=True)


def test_outputs_keep_their_signs() -> None:
    rng = np.random.default_rng(4)
    frames = np.cumsum(rng.normal(size=(600, 20)), axis=0)
    sfa = RecursiveFeature(20, 6, 3)
    sfa.update(frames[:20])
    for start in range(20, 600, 20):
        before = sfa.phi
        sfa.update(frames[start : start + 20])
        covariance = (sfa.state.basis.T * sfa.state.variance) @ sfa.state.basis
        assert (((before @ covariance) * sfa.phi).sum(axis=1) > 0).all()


def test_the_last_bit_of_large_values_is_no_direction() -> None:
    frames = np.full((50, 20), 1e6 / 3)
    frames[::2] = np.nextafter(frames[::2], 0.0)
    sfa = RecursiveFeature(20, 4)
    sfa.update(frames)
    assert sfa.state.counts.tolist() == [0, 50, 49]


def guarded(state: RecursiveState) -> tuple[RecursiveState, list[NDArray[Any]]]:
    """A state that lies between guards, and all of the memory it lies in."""
    memory = [np.full(array.size + 2 * GUARD, 7, array.dtype) for array in state]
    inside = [m[GUARD:-GUARD].reshape(a.shape) for m, a in zip(memory, state, strict=True)]
    for own, array in zip(inside, state, strict=True):
        own[...] = array
    return RecursiveState(*inside), memory


@given(
    stream=streams(),
    value=st.sampled_from([np.nan, np.inf, -np.inf, 1e200, -1e308, 5e-324, 1e-160]),
    seed=st.integers(0, 1000),
    share=st.sampled_from([0.001, 0.3, 1.0]),
)
@settings(max_examples=60)
def test_whatever_frames_hold_nothing_else_is_written(
    stream: tuple[RecursiveFeature, list[NDArray[Any]], list[bool]],
    value: float,
    seed: int,
    share: float,
) -> None:
    sfa, blocks, gaps = stream
    sfa.state, memory = guarded(sfa.state)
    rng = np.random.default_rng(seed)
    for frames, gap in zip(blocks, gaps, strict=True):
        values = frames.astype(np.float64)
        where = rng.random(values.shape) < share
        values[where] = value
        sfa.update(values, gap)
        assert 0 <= sfa.state.counts[0] <= len(sfa.state.variance)
        if not np.isfinite(value) and where.any():
            assert sfa.state.counts[0] == 0
            assert not np.isfinite(sfa.mean).all()
            assert np.isnan(sfa.slowness)
            assert not sfa.phi.any()
        sfa.compare(np.ones(frames.shape[1]))
    for own in memory:
        assert (own[:GUARD] == 7).all()
        assert (own[-GUARD:] == 7).all()


def learned(
    module: Any, sfa: RecursiveFeature, blocks: list[NDArray[Any]], gaps: list[bool]
) -> Any:
    """All that a kernel module makes of a stream."""
    sfa.state, _ = guarded(RecursiveState(*(np.zeros_like(array) for array in sfa.state)))
    vars(sfa).pop("_record", None)
    with using(module):
        changes = [sfa.update(x, gap) for x, gap in zip(blocks, gaps, strict=True)]
        return [*changes, *sfa.state, sfa.phi, *sfa.compare(np.ones_like(sfa.phi[0]))]


@pytest.mark.skipif(not kernels.WIDE, reason="this processor has no wide lanes")
@given(stream=streams())
@settings(max_examples=40)
def test_both_modules_give_the_same_bits(
    stream: tuple[RecursiveFeature, list[NDArray[Any]], list[bool]],
) -> None:
    from cdmisfa.kernels import _wide

    for plain, wide in zip(learned(_plain, *stream), learned(_wide, *stream), strict=True):
        np.testing.assert_array_equal(plain, wide)


@pytest.mark.parametrize("counts", [(9, 5, 4), (-1, 5, 4), (2**62, 5, 4), (3, -1, 4), (3, 5, -1)])
def test_a_state_that_points_nowhere_is_refused(counts: tuple[int, ...]) -> None:
    sfa = RecursiveFeature(20, 4)
    frames = np.random.default_rng(0).normal(size=(30, 20))
    sfa.update(frames)
    sfa.state.counts[:] = counts
    before = copied(sfa.state)
    with pytest.raises(UsageError, match="damaged state"):
        sfa.update(frames)
    for own, other in zip(sfa.state, before, strict=True):
        np.testing.assert_array_equal(own, other)


def test_a_window_that_shrank_is_no_broken_state() -> None:
    sfa = RecursiveFeature(20, 4, window=10)
    frames = np.random.default_rng(0).normal(size=(30, 20))
    sfa.update(frames)
    sfa.state.counts[1:] = 2**63 - 1
    sfa.update(frames)
    assert sfa.state.counts.tolist() == [8, 10, 10]


def test_arrays_of_other_shapes_are_refused() -> None:
    sfa = RecursiveFeature(20, 4)
    sfa.state = sfa.state._replace(weights=np.zeros((1, 7)))
    with pytest.raises(UsageError, match="weights is"):
        sfa.update(np.zeros((3, 20)))


@given(rows=st.integers(0, 9), parts=st.integers(0, 20), width=st.integers(1, 600))
def test_multiply(rows: int, parts: int, width: int) -> None:
    rng = np.random.default_rng(width)
    a, b = rng.normal(size=(rows, parts)), rng.normal(size=(parts, width))
    assert kernels.multiply(a, b) == pytest.approx(a @ b, abs=1e-12)
