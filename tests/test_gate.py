"""The gate: which blocks are known, which carry nothing."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from kernel_agent import is_constant, recognised
from reference.agent import BAND, CONSTANT_VARIANCE

from cdmisfa.agents.agent import NOVEL
from cdmisfa.kernels import instantaneous_slowness

RNG = np.random.default_rng(3)
Y = np.ascontiguousarray(RNG.standard_normal((3, 40, 2)))
ETA = np.array([instantaneous_slowness(y) for y in Y])
SD = np.full((3, 2), 0.01)


def ask(mean: np.ndarray, sd: np.ndarray, y: np.ndarray = Y) -> int:
    return recognised(y, mean, sd)[0]


def test_the_first_module_that_knows_the_block_is_named() -> None:
    far = ETA + 1.0
    assert ask(far, SD) == NOVEL
    for first in (0, 1, 2):
        mean = far.copy()
        mean[first:] = ETA[first:]
        assert ask(mean, SD) == first + 1


def test_the_edge_of_two_standard_deviations_is_known() -> None:
    y, eta = Y[:1, :, :1].copy(), ETA[:1, :1]
    sd = np.array([[2.0**-6]])
    for sign in (1, -1):
        # Powers of two, so that the distance is exact and the edge is hit to the bit.
        mean = np.round(eta * 2**20) / 2**20
        shift = eta - mean
        assert ask(mean, np.abs(shift) / BAND, y) == 1
        outside = np.nextafter(np.abs(shift) / BAND, 0.0)
        assert ask(mean, outside, y) == NOVEL
        assert ask(eta + sign * 1.99 * sd, sd, y) == 1
        assert ask(eta + sign * 2.01 * sd, sd, y) == NOVEL


def test_nothing_is_known_by_a_band_that_is_no_number() -> None:
    nan = np.full((3, 2), np.nan)
    assert ask(nan, SD) == NOVEL
    assert ask(ETA, nan) == NOVEL
    constant = np.zeros((1, 40, 1))
    assert ask(np.array([[0.01]]), np.array([[0.01]]), constant) == NOVEL


@pytest.mark.parametrize("dtype", ["uint8", "float64"])
def test_constant_blocks(dtype: str) -> None:
    frames = np.full((40, 6), 200, dtype=dtype)
    assert is_constant(frames)
    frames[17, 3] += 1
    assert not is_constant(frames)
    frames = np.tile(np.arange(64, dtype=dtype), (40, 1))  # from pixel to pixel only
    assert is_constant(frames)


@given(st.floats(-1e6, 1e6), st.sampled_from([0.25, 4.0]))
def test_the_least_variance_is_relative_to_the_offset_of_the_input(
    offset: float, share: float
) -> None:
    half = np.sqrt(share * CONSTANT_VARIANCE)
    values = offset + half * np.where(np.arange(40) % 2, 1.0, -1.0)
    true_variance = np.var(values - values[0])
    if not 0.9 < true_variance / CONSTANT_VARIANCE < 1.1:
        assert is_constant(values[:, None].copy()) == (true_variance <= CONSTANT_VARIANCE)
