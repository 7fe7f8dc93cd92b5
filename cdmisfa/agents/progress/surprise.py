"""What rules of attention of other people's measure on every block: prediction errors, novelty."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cdmisfa import kernels
from cdmisfa.agents.progress.candidate import Candidate
from cdmisfa.core.arrays import FloatArray

PROJECTED: Final = 16
"""Numbers of a frame that networks are shown."""

HIDDEN: Final = 64
"""Units of a network's hidden layer."""

DISTILLED: Final = 8
"""Outputs of the network that is distilled."""

RATE: Final = 0.5
"""Share of an error that is learned away at once, were all frames alike."""

CLIP: Final = 5.0
"""Standard deviations within which a network's inputs are kept."""


def prediction_error(candidate: Candidate) -> float:
    """Mean square error of the candidate's outputs on a block, each predicted from the last.

    The prediction is y(t + 1) = rho y(t), with the rho that the slowness fitted so far implies:
    1 for white noise, which nothing predicts, and 0 for what stands still.
    """
    y = candidate.y[np.isfinite(candidate.y).all(axis=1)]
    fitted = candidate.sfa.state.spectrum[: y.shape[1]]
    if len(y) < 2 or not np.isfinite(fitted).all():
        return 1.0
    rho = np.maximum(1.0 - 2.0 * (np.pi * fitted) ** 2, -1.0)
    return float(((y[1:] - rho * y[:-1]) ** 2).mean())


class Surprise:
    """The last prediction errors of every stream.

    Args:
        n_streams: S.
        recent: how many are kept of each.
        n_inputs: I.

    Attributes:
        errors: (S, recent), the newest last; NaN before.
    """

    def __init__(self, n_streams: int, recent: int, n_inputs: int) -> None:
        self.errors = np.full((n_streams, recent), np.nan)

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """Everything that changes in it, by name; no copies."""
        return {"surprise.errors": self.errors}

    def take(self, stream: int, frames: NDArray[Any], candidate: Candidate) -> None:
        """Take in a block, (n, I), and the candidate that was tested on it."""
        row = self.errors[stream]
        row[:-1] = row[1:]
        row[-1] = self.measure(frames, candidate)

    def measure(self, frames: NDArray[Any], candidate: Candidate) -> float:
        """How much there is to wonder about in a block."""
        return prediction_error(candidate)


class Distillation(Surprise):
    """Random network distillation (Burda et al. 2018): how well a fixed random network is imitated.

    Both networks see a few random projections of a frame, in units of their scatter so far, and
    have one hidden layer. Of the imitator the last layer learns, from each block once.
    """

    def __init__(self, n_streams: int, recent: int, n_inputs: int) -> None:
        super().__init__(n_streams, recent, n_inputs)
        rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(0)))

        def drawn(rows: int, columns: int) -> FloatArray:
            return np.asarray(rng.uniform(-1.0, 1.0, (rows, columns)) * (3.0 / columns) ** 0.5)

        self._projection = drawn(PROJECTED, n_inputs)
        self._hidden = drawn(2 * HIDDEN, PROJECTED)
        self._target = drawn(DISTILLED, HIDDEN)
        self._learned = np.zeros((DISTILLED, HIDDEN))
        self._moments = np.zeros((2, PROJECTED))
        self._seen = np.zeros(1)

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """Everything that changes in it, by name; no copies."""
        names = ("learned", "moments", "seen")
        own = (self._learned, self._moments, self._seen)
        more = {f"surprise.{name}": array for name, array in zip(names, own, strict=True)}
        return super().arrays | more

    def measure(self, frames: NDArray[Any], candidate: Candidate) -> float:
        """Mean square error of the imitation on a block, before it is learned from."""
        shown = kernels.outputs(self._projection, np.zeros(PROJECTED), frames)
        now = np.stack([shown.mean(axis=0), (shown * shown).mean(axis=0)])
        self._seen += 1.0
        self._moments += (now - self._moments) / self._seen
        mean, square = self._moments
        scatter = np.sqrt(np.maximum(square - mean * mean, 1e-12))
        inputs = np.clip((shown - mean) / scatter, -CLIP, CLIP)
        both = np.maximum(_layer(self._hidden, inputs), 0.0)
        own = np.ascontiguousarray(both[:, HIDDEN:])
        wanted = _layer(self._target, np.ascontiguousarray(both[:, :HIDDEN]))
        missing = wanted - _layer(self._learned, own)
        step = (missing[:, :, None] * own[:, None, :]).mean(axis=0)
        self._learned += RATE * step / max(float((own * own).sum(axis=1).mean()), 1e-12)
        return float((missing * missing).mean())


def _layer(weights: FloatArray, inputs: FloatArray) -> FloatArray:
    return kernels.outputs(weights, np.zeros(len(weights)), inputs)


MEASURES: Mapping[str, type[Surprise]] = {
    "prediction": Surprise,
    "lpm": Surprise,
    "rnd": Distillation,
}
"""What the rules measure that need more than learning errors, by the name `learner.attention`."""
