"""The quadratic expansion."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cdmisfa.core.errors import UsageError
from cdmisfa.core.expansion import expanded_size, quadratic


def test_two_inputs_expand_in_the_order_of_the_paper():
    a, b = 3.0, 5.0
    np.testing.assert_array_equal(quadratic(np.array([[a, b]])), [[a, b, a * a, a * b, b * b]])


@given(
    arrays(np.float64, st.tuples(st.integers(1, 4), st.integers(1, 5)), elements=st.floats(-9, 9))
)
@settings(deadline=None, max_examples=30)
def test_every_product_of_two_inputs_is_there_once(frames):
    n, size = frames.shape
    products = [frames[:, i] * frames[:, j] for i in range(size) for j in range(i, size)]
    expected = np.concatenate([frames, np.stack(products, axis=1)], axis=1)
    out = quadratic(frames)
    assert out.shape == (n, expanded_size("quadratic", size))
    np.testing.assert_array_equal(out, expected)


def test_pixels_count_a_255th():
    pixels = np.array([[255, 51]], dtype=np.uint8)
    np.testing.assert_allclose(quadratic(pixels), [[1.0, 0.2, 1.0, 0.2, 0.04]])


def test_no_expansion_keeps_the_size_and_an_unknown_one_is_refused():
    assert expanded_size("none", 6144) == 6144
    with pytest.raises(UsageError, match="'cubic': choose from none, quadratic"):
        expanded_size("cubic", 2)
