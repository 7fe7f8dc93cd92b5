"""Batch SFA: known answers."""

import numpy as np
import pytest

from cdmisfa.core.expansion import quadratic
from cdmisfa.features.sfa import batch_sfa, slowness
from recorder.world.oscillatory import one_period


@pytest.mark.parametrize(("name", "cycles"), [("x1", 4), ("x2", 3), ("x3", 2)])
def test_slowest_feature_of_an_oscillatory_stream_has_the_frequency_of_its_equation(name, cycles):
    frames = quadratic(np.tile(one_period(name), (2, 1)))
    y = (frames - frames.mean(axis=0)) @ batch_sfa(frames, 1).T
    assert slowness(y)[0] == pytest.approx(cycles / 500, rel=2e-3)
    assert y.var() == pytest.approx(1.0)


def test_features_are_white_and_ordered_from_slow_to_fast():
    t = np.arange(4000)
    sources = np.stack([np.sin(2 * np.pi * f * t) for f in (0.05, 0.002, 0.01)], axis=1)
    mixing = np.random.default_rng(0).standard_normal((3, 7))
    frames = sources @ mixing + 3.0
    y = (frames - frames.mean(axis=0)) @ batch_sfa(frames, 3).T
    np.testing.assert_allclose(np.cov(y.T, bias=True), np.eye(3), atol=1e-9)
    np.testing.assert_allclose(slowness(y), [0.002, 0.01, 0.05], rtol=0.01)


def test_more_features_than_directions_are_refused():
    frames = np.outer(np.sin(np.arange(100.0)), [1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="vary in 1 directions"):
        batch_sfa(frames, 2)
