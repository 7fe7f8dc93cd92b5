"""`IncSFA`: an adaptive abstraction with the kernel that suits its input."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arithmetic.compiled import in_compiled_code
from cdmisfa.core.blocks import as_frames
from cdmisfa.core.config import LearnerConfig
from cdmisfa.features.feature import feed
from cdmisfa.features.incsfa import gram, strict
from cdmisfa.features.incsfa.state import Float, Params, State, new_state, parameters

MANY_INPUTS = 200
"""From here on the Gram kernel is faster, hence taken; the choice depends on nothing else."""


class Strict(NamedTuple):
    """An abstraction as compiled code takes it, to be learned by `strict.update`."""

    phi: Float
    mean: Float
    state: State
    params: Params


class Gram(Strict):
    """The same, to be learned by `gram.update`."""


UPDATES: Any = {Strict: strict.update, Gram: gram.update}


class IncSFA:
    """Incremental slow feature analysis, frame by frame.

    Attributes:
        state: every array the abstraction consists of.
        kernel: the same with the constants of the rule, for compiled code.
        arithmetic: version of the order in which that kernel computes.

    Example:
        >>> sfa = IncSFA(LearnerConfig(), 5, np.random.default_rng(0))
        >>> sfa.update(np.random.default_rng(1).random((100, 5))).shape
        (100,)
    """

    def __init__(self, config: LearnerConfig, n_inputs: int, rng: np.random.Generator) -> None:
        self.state = new_state(rng, n_inputs, config)
        kind = Gram if n_inputs >= MANY_INPUTS else Strict
        self.kernel = kind(self.state.phi, self.state.mean, self.state, parameters(config))
        self.arithmetic = gram.ARITHMETIC if kind is Gram else 1

    def update(self, frames: NDArray[Any], gap: bool = False) -> Float:
        """Learn from consecutive frames.

        Args:
            frames: (n, I) float64 values, or uint8 pixels, which count 1/255 each.
            gap: the first frame does not follow the last one learned from.

        Returns:
            xi, (n,): change of phi at each frame, NaN at the first after a gap.

        Raises:
            UsageError: these are no frames of I values.
        """
        rows = as_frames(frames, len(self.state.mean))
        xi = np.empty(len(rows))
        UPDATES[type(self.kernel)](self.state, self.kernel.params, rows, gap, xi)
        return xi

    @property
    def phi(self) -> Float:
        """Slow features as weights of the centred input, (J, I)."""
        return self.state.phi

    @property
    def mean(self) -> Float:
        """Running mean of the input, (I,)."""
        return self.state.mean


@in_compiled_code(feed)
def _feed(feature: Any, frames: Any, gap: Any) -> Any:
    update = UPDATES.get(getattr(feature, "instance_class", None))
    if update is None:
        return None

    def feed_kernel(feature: Any, frames: Any, gap: Any) -> Any:
        xi = np.empty(len(frames))
        update(feature.state, feature.params, frames, gap, xi)
        return xi

    return feed_kernel
