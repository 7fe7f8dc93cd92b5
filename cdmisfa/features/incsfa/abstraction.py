"""`IncSFA`: an adaptive abstraction with the kernel that suits its input."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.config import LearnerConfig
from cdmisfa.features.incsfa import gram, strict
from cdmisfa.features.incsfa.state import Float, new_state, parameters

MANY_INPUTS = 200
"""From here on the Gram kernel is faster, hence taken; the choice depends on nothing else."""


class IncSFA:
    """Incremental slow feature analysis, frame by frame.

    Attributes:
        state: every array the abstraction consists of.
        params: constants of the rule.

    Example:
        >>> sfa = IncSFA(LearnerConfig(), 5, np.random.default_rng(0))
        >>> sfa.update(np.random.default_rng(1).random((100, 5))).shape
        (100,)
    """

    def __init__(self, config: LearnerConfig, n_inputs: int, rng: np.random.Generator) -> None:
        self.state = new_state(rng, n_inputs, config)
        self.params = parameters(config)
        self._kernel = gram.update if n_inputs >= MANY_INPUTS else strict.update

    def update(self, frames: NDArray[Any], gap: bool = False) -> Float:
        """Learn from consecutive frames.

        Args:
            frames: (n, I) float64 values, or uint8 pixels, which count 1/255 each.
            gap: the first frame does not follow the last one learned from.

        Returns:
            xi, (n,): change of phi at each frame, NaN at the first after a gap.
        """
        xi = np.empty(len(frames))
        frames = frames.view()
        frames.flags.writeable = False  # numba compiles read-only and writable arrays apart
        self._kernel(self.state, self.params, frames, gap, xi)
        return xi

    @property
    def phi(self) -> Float:
        """Slow features as weights of the centred input, (J, I)."""
        return self.state.phi

    @property
    def mean(self) -> Float:
        """Running mean of the input, (I,)."""
        return self.state.mean
