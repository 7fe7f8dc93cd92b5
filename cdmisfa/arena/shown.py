"""What a stream shows: `Shown`, and the size of its pictures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

HEIGHT, WIDTH = 48, 64
"""Of the grey pictures of all cameras."""

Rng = np.random.Generator
Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Shown:
    """The frames of a stream, with the state of the world behind each where there is one.

    Attributes:
        frames: (n, *frame_shape), uint8 pixels or float64 values.
        state: (n, C) float64; C may be 0.
        names: a name for each column of `state`.
    """

    frames: NDArray[Any]
    state: Float
    names: tuple[str, ...] = ()


def stateless(frames: NDArray[Any]) -> Shown:
    """Frames behind which there is nothing to be known."""
    return Shown(frames, np.zeros((len(frames), 0)))


def pixels(values: NDArray[Any]) -> NDArray[np.uint8]:
    """Values as pixels: rounded, and cut off at black and white."""
    return np.asarray(np.rint(values).clip(0, 255), np.uint8)
