"""Elementary functions by additions, multiplications and divisions alone, in a fixed order.

Those of C libraries and of numpy are as exact, but their last bit depends on the processor.
Each name here is the library's function in ordinary arithmetic.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arithmetic.choice import Either
from cdmisfa.core.arithmetic.compiled import compiled

Float = NDArray[np.float64]

LN_2 = 0.693147180559945309417
_LN_2_HIGH = 6.93147180369123816490e-01
"""Its first 33 bits, so that products with exponents are exact; `_LN_2_LOW` is the rest."""

_LN_2_LOW = 1.90821492927058770002e-10

_HALF_PI = (1.57079632673412561417, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
"""In parts: the first two of 33 bits, the last the rest."""

_SQUARE_ROOT_HALF = 0.707106781186547524401

_LOG_TERMS, _EXP_TERMS, _SINE_TERMS = 12, 14, 10
"""Terms of the series below; the next ones would be less than half of the last bit."""

_LEAST_EXP = -745.2
"""Below this exp is 0."""


def _exp(x: float) -> float:
    """Exp of x <= 700."""
    if x < _LEAST_EXP:
        return 0.0
    halvings = math.floor(x / LN_2 + 0.5)
    rest = (x - halvings * _LN_2_HIGH) - halvings * _LN_2_LOW
    total = 1.0
    for n in range(_EXP_TERMS, 0, -1):
        total = 1.0 + rest * total / n
    return math.ldexp(total, int(halvings))


def _log(x: float) -> float:
    """Natural logarithm of x > 0."""
    mantissa, exponent = math.frexp(x)
    if mantissa < _SQUARE_ROOT_HALF:
        mantissa, exponent = 2.0 * mantissa, exponent - 1
    ratio = (mantissa - 1.0) / (mantissa + 1.0)
    square, total = ratio * ratio, 0.0
    for n in range(_LOG_TERMS, 0, -1):
        total = (total + 1.0 / (2 * n + 1)) * square
    small = 2.0 * ratio * total + exponent * _LN_2_LOW
    return exponent * _LN_2_HIGH + (2.0 * ratio + small)


def _quarter_turns(x: Any) -> tuple[Any, Any, Any]:
    """Sine and cosine of what x is beyond whole quarter turns, and how many these are."""
    first, second, third = _HALF_PI
    turns = np.floor(x / (first + second) + 0.5)
    rest = ((x - turns * first) - turns * second) - turns * third
    square = rest * rest
    sine, cosine = 1.0, 1.0
    for n in range(_SINE_TERMS, 0, -1):
        sine = 1.0 - square * sine / ((2 * n) * (2 * n + 1))
        cosine = 1.0 - square * cosine / ((2 * n - 1) * (2 * n))
    return rest * sine, cosine, turns % 4


def _sin(x: Float) -> Float:
    sine, cosine, turns = _quarter_turns(x)
    return np.asarray(np.where(turns % 2 == 0, sine, cosine)) * np.where(turns < 2, 1.0, -1.0)


def _cos(x: Float) -> Float:
    sine, cosine, turns = _quarter_turns(x)
    flip = (turns == 1) | (turns == 2)
    return np.asarray(np.where(turns % 2 == 0, cosine, sine)) * np.where(flip, -1.0, 1.0)


@compiled
def _library_exp(x: float) -> float:
    return math.exp(x)


exp: Callable[[float], float] = Either(_library_exp, lambda: compiled(_exp))
"""Exp of a number up to 700; for compiled code, too."""

log: Callable[[float], float] = Either(math.log, lambda: compiled(_log))
"""Natural logarithm of a number above 0."""

sin: Callable[[Float], Float] = Either(np.sin, lambda: _sin)
"""Sines of an array of numbers up to a million."""

cos: Callable[[Float], Float] = Either(np.cos, lambda: _cos)
"""Cosines of the same."""


def _fading(base: float, n: int) -> Float:
    return np.asarray(base ** np.arange(n)[::-1])


def _fading_step_by_step(base: float, n: int) -> Float:
    return np.asarray(np.multiply.accumulate(np.append(1.0, np.full(n - 1, base)))[::-1])


fading: Callable[[float, int], Float] = Either(_fading, lambda: _fading_step_by_step)
"""n >= 1 weights, from base^(n-1) to 1."""


@compiled
def _to_radius(uniform: Float) -> None:
    for i in range(len(uniform)):
        uniform[i] = math.sqrt(-2.0 * log(1.0 - uniform[i]))


def _normal(rng: np.random.Generator, shape: tuple[int, ...]) -> Float:
    return rng.standard_normal(shape)


def _box_muller(rng: np.random.Generator, shape: tuple[int, ...]) -> Float:
    radius, angle = rng.random((2, math.prod(shape)))
    _to_radius(radius)
    return np.asarray(radius * _cos(2.0 * math.pi * angle)).reshape(shape)


normal: Callable[[np.random.Generator, tuple[int, ...]], Float] = Either(
    _normal, lambda: _box_muller
)
"""Standard normal draws of a generator, of a shape."""
