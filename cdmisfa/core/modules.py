"""A module: an abstraction that was learned, saved and frozen."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Module:
    """A frozen abstraction with the policy that led to it.

    Attributes:
        index: order of learning, from 1.
        stream: stream that was watched when it was saved, from 0.
        iteration: iteration at whose end it was saved.
        phi: (J, I) weights; y = phi (x - mean), x after scaling and expansion.
        mean: (I,) mean of the input.
        band_mean: (J,) running mean of eta_inst; centre of the novelty band.
        band_sd: (J,) running standard deviation of eta_inst.
        eta: (J,) slowness of each output when saved, cycles per frame.
        policy: (S,) 0 stay, 1 switch, for each stream.
        centres: (S, C, tau, J) centres of the clusters; empty but for CD-MISFA 1.0.
        counts: (S, C) what each centre has seen; empty but for CD-MISFA 1.0.
    """

    index: int
    stream: int
    iteration: int
    phi: NDArray[np.float64]
    mean: NDArray[np.float64]
    band_mean: NDArray[np.float64]
    band_sd: NDArray[np.float64]
    eta: NDArray[np.float64]
    policy: NDArray[np.int64]
    centres: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0, 0, 0)))
    counts: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))
