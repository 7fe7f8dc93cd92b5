"""The objects' motions: the paper's statistics, and frame t whatever came before."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from recorder.world.icub.config import IcubConfig
from recorder.world.icub.motions import CHUNK, Motions

SCENE = IcubConfig()
WHOLE = Motions(SCENE, 3).positions(0, 2 * CHUNK + 100)


@given(st.lists(st.tuples(st.integers(0, 2 * CHUNK), st.integers(1, 3000)), max_size=6))
@settings(max_examples=25, deadline=None)
def test_positions_depend_on_the_frame_alone(blocks):
    motions = Motions(SCENE, 3)
    for start, n in blocks:
        got = motions.positions(start, n)
        assert got.shape == (n, 3, 2)
        expected = WHOLE[start : start + n]
        np.testing.assert_array_equal(got[: len(expected)], expected)


def test_object_1_toggles_y_and_is_uniform_in_x():
    x, y = WHOLE[:, 0].T
    np.testing.assert_array_equal(y[:30], [0.4] * 10 + [0.6] * 10 + [0.4] * 10)
    assert set(np.unique(y)) == {0.4, 0.6}
    assert -0.6 <= x.min() < -0.59
    assert -0.41 < x.max() <= -0.4
    assert abs(np.corrcoef(x[1:], x[:-1])[0, 1]) < 0.05


def test_object_2_is_uniform_and_forgets():
    low, high = WHOLE[:, 1].min(axis=0), WHOLE[:, 1].max(axis=0)
    np.testing.assert_allclose([low, high], [[-0.8, -0.1], [-0.6, 0.1]], atol=0.002)
    for values in WHOLE[:, 1].T:
        assert abs(np.corrcoef(values[1:], values[:-1])[0, 1]) < 0.05


def test_object_3_walks_within_its_limits_y_slower_than_x():
    path = WHOLE[:, 2]
    assert path.min() >= -0.58
    assert path.max() <= -0.42
    assert path[:, 1].max() - path[:, 1].min() > 0.1
    steps = np.diff(path, axis=0)
    assert 0.0035 < steps[:, 1].std() < 0.0041
    assert steps[:, 0].std() > 10 * steps[:, 1].std()
    assert np.corrcoef(path[1:, 1], path[:-1, 1])[0, 1] > 0.99
