"""Nonlinear expansions of the input, so that linear features of it are nonlinear ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import as_frames
from cdmisfa.core.blocks import PIXEL, UINT8
from cdmisfa.core.errors import Registry


@dataclass(frozen=True, slots=True)
class Expansion:
    """How frames are expanded.

    Attributes:
        size: length of an expanded frame, from that of a frame.
        function: (n, I) uint8 pixels, which count 1/255 each, or float64 values, in C order and
            not to be written -> (n, size(I)) pixels or values. A row depends on its frame only.
    """

    size: Callable[[int], int]
    function: Callable[[NDArray[Any]], NDArray[Any]]


def _inputs_and_products(frames: NDArray[Any]) -> NDArray[np.float64]:
    x = frames * PIXEL if frames.dtype == UINT8 else frames
    first, second = _pairs(x.shape[1])
    return np.concatenate([x, x[:, first] * x[:, second]], axis=1)


@cache
def _pairs(size: int) -> tuple[NDArray[np.intp], ...]:
    return np.triu_indices(size)


# Every expansion, by the name that `learner.expansion` takes.
EXPANSIONS: Registry[Expansion] = Registry(
    "learner.expansion",
    {
        "none": Expansion(lambda n: n, lambda frames: frames),
        "quadratic": Expansion(lambda n: n + n * (n + 1) // 2, _inputs_and_products),
    },
)


def expanded_size(kind: str, n_inputs: int) -> int:
    """Length of an expanded frame.

    Args:
        kind: a name in `EXPANSIONS`.
        n_inputs: length I of a frame.

    Raises:
        UsageError: there is no such expansion.
    """
    return EXPANSIONS[kind].size(n_inputs)


def expand(kind: str, frames: Any) -> NDArray[Any]:
    """Expanded frames.

    Args:
        kind: a name in `EXPANSIONS`.
        frames: (n, I) uint8 pixels, which count 1/255 each, or float64 values.

    Raises:
        UsageError: there is no such expansion, these are no frames, or it gives none.
    """
    expansion, rows = EXPANSIONS[kind], as_frames(frames)
    return as_frames(expansion.function(rows), expansion.size(rows.shape[1]))


def quadratic(frames: Any) -> NDArray[np.float64]:
    """Return all inputs, then all products of two: (x1, x2, x1^2, x1 x2, x2^2) for two inputs."""
    return expand("quadratic", frames)
