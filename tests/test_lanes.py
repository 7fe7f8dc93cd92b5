"""Fused multiply-adds without an instruction for them: rounded as with one, to the bit."""

from fractions import Fraction

import numpy as np
import pytest
from both_modules import assert_same_bits, both_modules
from hypothesis import given, settings
from hypothesis import strategies as st

from cdmisfa import kernels


def fused(x: float, y: np.ndarray, z: np.ndarray) -> list[np.ndarray]:
    """(n,) of x y + z by both modules: y and z are parts of a product of matrices."""
    result = []
    for module in both_modules():
        with module, np.errstate(all="ignore"):
            result.append(kernels.multiply(np.array([[1.0, x]]), np.stack([z, y]))[0])
    return result


@pytest.mark.parametrize("seed", range(4))
def test_products_that_nearly_cancel(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(50):
        x, y = rng.standard_normal(), rng.standard_normal(1003)
        product = x * y
        z = -product * (1 + rng.integers(-4, 5, 1003) * 2.0 ** rng.integers(-70, -40, 1003))
        assert_same_bits(*[[a] for a in fused(x, y, z)])
        halfway = np.ldexp(product, rng.integers(50, 58, 1003))
        assert_same_bits(*[[a] for a in fused(x, y, halfway)])


@settings(max_examples=300)
@given(bits=st.lists(st.integers(0, 2**64 - 1), min_size=3, max_size=40))
def test_any_three_numbers(bits: list[int]) -> None:
    """Also none, infinities, zeros with a sign, and the smallest there are."""
    numbers = np.array(bits, np.uint64).view(np.float64)
    x, rest = float(numbers[0]), numbers[1:]
    for z in (rest[::-1], np.roll(rest, 1) * 2.0**-60, np.zeros_like(rest), -rest * x):
        assert_same_bits(*[[a] for a in fused(x, rest, np.ascontiguousarray(z))])


def test_what_is_exact_is_rounded_once() -> None:
    rng = np.random.default_rng(0)
    for x, y, z in rng.standard_normal((200, 3)) * 10.0 ** rng.integers(-9, 9, (200, 3)):
        exact = float(Fraction(x) * Fraction(y) + Fraction(z))
        for result in fused(x, np.full(5, y), np.full(5, z)):
            assert result.tolist() == [exact] * 5
