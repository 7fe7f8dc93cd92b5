"""Nonlinear expansions of frames: features linear in an expansion are nonlinear in the inputs."""

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
    """One way to expand frames.

    Attributes:
        size: returns the length of an expanded frame for the length of a frame.
        function: expands frames (n, I) to (n, size(I)). Frames are uint8 pixels, which count
            1/255 each, or float64 values, in C order and read-only. Each row of the result must
            depend on its own frame only.
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


# All expansions, by their name in `learner.expansion`.
EXPANSIONS: Registry[Expansion] = Registry(
    "learner.expansion",
    {
        "none": Expansion(lambda n: n, lambda frames: frames),
        "quadratic": Expansion(lambda n: n + n * (n + 1) // 2, _inputs_and_products),
    },
)


def expanded_size(kind: str, n_inputs: int) -> int:
    """Return the length of an expanded frame.

    Args:
        kind: a name in `EXPANSIONS`.
        n_inputs: length I of a frame.

    Raises:
        UsageError: the expansion does not exist.
    """
    return EXPANSIONS[kind].size(n_inputs)


def expand(kind: str, frames: Any) -> NDArray[Any]:
    """Return expanded frames, (n, size(I)).

    Args:
        kind: a name in `EXPANSIONS`.
        frames: (n, I) uint8 pixels, which count 1/255 each, or float64 values.

    Raises:
        UsageError: the expansion does not exist, or does not return frames of its size.
    """
    expansion, rows = EXPANSIONS[kind], as_frames(frames)
    return as_frames(expansion.function(rows), expansion.size(rows.shape[1]))


def quadratic(frames: Any) -> NDArray[np.float64]:
    """Return all inputs and all products of two: (x1, x2, x1^2, x1 x2, x2^2) for two inputs."""
    return expand("quadratic", frames)
