"""What an adaptive abstraction must be, so that a learner can learn with it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.config import LearnerConfig


@runtime_checkable
class Feature(Protocol):
    """Slow features that are learned frame by frame: y = phi (x - mean).

    One that also has `kernel`, a record of its arrays as `IncSFA` has it, is learned with in C.
    """

    def update(self, frames: NDArray[Any], gap: bool = False) -> FloatArray:
        """Learn from consecutive frames.

        Args:
            frames: (n, I) uint8 pixels, which count 1/255 each, or float64 values, expanded.
            gap: the first frame does not follow the last one learned from.

        Returns:
            xi, (n,): change of phi at each frame, NaN where there is none to tell.
        """

    @property
    def phi(self) -> FloatArray:
        """Weights of the centred input, (J, I)."""

    @property
    def mean(self) -> FloatArray:
        """Mean of the input, (I,)."""

    @property
    def state(self) -> Any:
        """Every array that changes, as a named tuple; restored by writing into them."""


MakeFeature = Callable[[LearnerConfig, int, np.random.Generator], Feature]
"""How a learner makes a feature: configuration, length of an expanded frame, where to draw."""
