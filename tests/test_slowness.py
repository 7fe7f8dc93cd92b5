"""Slowness: known signals, and the equations' invariants."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cdmisfa import kernels
from cdmisfa.features.outputs import slowness_by_moments, window_rate

signals = arrays(np.float64, st.integers(3, 60), elements=st.floats(-1e3, 1e3))


def instantaneous_slowness(y: np.ndarray) -> float:
    return float(kernels.instantaneous_slowness(y[:, None])[0])


def eta(y: np.ndarray) -> float:
    """Equation 2 written down once more, in numpy."""
    return float(np.sqrt(np.mean(np.diff(y) ** 2) / np.var(y)) / (2 * np.pi))


@pytest.mark.parametrize(("cycles", "frames"), [(2, 500), (3, 500), (4, 500), (44, 500), (7, 90)])
def test_eta_of_a_sampled_sine_is_sin_pi_f_over_pi(cycles: int, frames: int) -> None:
    theta = 2 * np.pi * cycles * np.arange(100 * frames) / frames
    f = cycles / frames
    assert instantaneous_slowness(np.sin(theta)) == pytest.approx(
        math.sin(math.pi * f) / math.pi, rel=2e-3
    )


def test_white_noise_has_eta_0_2251() -> None:
    y = np.random.default_rng(0).standard_normal(200_000)
    assert instantaneous_slowness(y) == pytest.approx(math.sqrt(2) / (2 * math.pi), rel=0.01)
    assert instantaneous_slowness(y) == pytest.approx(0.2251, rel=0.01)


@given(signals)
def test_eta_inst_is_equation_4(y: np.ndarray) -> None:
    if np.var(y) > 1e-6:
        assert instantaneous_slowness(y) == pytest.approx(eta(y), rel=1e-9)


@given(signals, st.floats(0.1, 100), st.floats(-100, 100))
def test_eta_ignores_scale_sign_and_offset(y: np.ndarray, scale: float, offset: float) -> None:
    if np.var(y) > 1e-3:
        expected = instantaneous_slowness(y)
        assert instantaneous_slowness(-scale * y + offset) == pytest.approx(expected, rel=1e-6)


def test_a_signal_without_variance_has_no_slowness() -> None:
    assert slowness_by_moments(1.0, 0.0) == math.inf
    assert slowness_by_moments(1.0, -1e-20) == math.inf
    assert instantaneous_slowness(np.full(10, 3.0)) == math.inf


@settings(max_examples=50)
@given(arrays(np.float64, st.integers(1, 15), elements=st.floats(-10, 10)))
def test_a_window_starts_as_the_plain_mean(values: np.ndarray) -> None:
    mean = 0.0
    for k, value in enumerate(values, start=1):
        mean += window_rate(40.0, k) * (value - mean)
    assert mean == pytest.approx(np.mean(values), abs=1e-9)
