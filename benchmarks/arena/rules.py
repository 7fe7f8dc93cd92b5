"""Attention rules from the literature, for the progress learner.

They are reduced to streams in place of tasks, states or actions, and to the learning error of
each stream's candidate. `Attentive` is the learner with one of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.agents.progress.attention import ERROR_BLOCKS, PROGRESS_BLOCKS, Situation, exploring
from cdmisfa.agents.progress.candidate import Candidate
from cdmisfa.agents.progress.config import ProgressConfig
from cdmisfa.agents.progress.learner import ProgressLearner
from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.blocks import SourceSpec


class Attentive(ProgressLearner):
    """The progress learner with another rule of attention.

    Args:
        config: of the learner.
        spec: of the source.
        seed: of the learner.
        name: of the rule in `RULES`.

    Attributes:
        surprise: (S, ERROR_BLOCKS) value that the rule measured on the last blocks of each stream,
            the newest last; NaN before.
    """

    def __init__(self, config: ProgressConfig, spec: SourceSpec, seed: int, name: str) -> None:
        super().__init__(config, spec, seed)
        self.surprise = np.full((len(spec.streams), ERROR_BLOCKS), np.nan)
        self._measure = Distillation(self._n_inputs) if name == "rnd" else prediction_error
        self.rule = lambda situation: RULES[name](situation, self.surprise)

    def _decide(self, stream: int, candidate: Candidate, frames: NDArray[Any]) -> tuple[str, ...]:
        row = self.surprise[stream]
        row[:] = np.append(row[1:], self._measure(frames, candidate))
        return super()._decide(stream, candidate, frames)


def prediction_error(frames: NDArray[Any], candidate: Candidate) -> float:
    """Return the mean square error of outputs on a block, each predicted from the one before.

    The prediction is y(t + 1) = rho y(t), with the rho that the slowness fitted so far implies:
    1 for white noise, which nothing predicts, and 0 for a constant.
    """
    y = candidate.y[np.isfinite(candidate.y).all(axis=1)]
    fitted = candidate.sfa.output_slowness
    if len(y) < 2 or not np.isfinite(fitted).all():
        return 1.0
    rho = np.maximum(1.0 - 2.0 * (np.pi * fitted) ** 2, -1.0)
    return float(((y[1:] - rho * y[:-1]) ** 2).mean())


class Distillation:
    """Random network distillation (Burda et al. 2018): how well a fixed network is imitated.

    Both networks see 16 random projections of a frame, in units of their scatter so far, and have
    one hidden layer of 64 units and 8 outputs. The imitator's last layer learns from each block.
    """

    def __init__(self, n_inputs: int) -> None:
        rng = np.random.default_rng(0)
        sizes = ((16, n_inputs), (64, 16), (64, 16), (8, 64))
        drawn = [rng.uniform(-1.0, 1.0, size) * (3.0 / size[1]) ** 0.5 for size in sizes]
        self._projection, self._hidden, self._imitator, self._target = drawn
        self._learned, self._moments, self._blocks = np.zeros((8, 64)), np.zeros((2, 16)), 0

    def __call__(self, frames: NDArray[Any], candidate: Candidate) -> float:
        """Return the imitation's mean square error on a block, before it is learned from."""
        features = frames @ self._projection.T
        self._blocks += 1
        now = np.stack([features.mean(axis=0), (features * features).mean(axis=0)])
        self._moments += (now - self._moments) / self._blocks
        mean, square = self._moments
        scatter = np.sqrt(np.maximum(square - mean * mean, 1e-12))
        inputs = np.clip((features - mean) / scatter, -5.0, 5.0)
        hidden = np.maximum(inputs @ self._imitator.T, 0.0)
        wanted = np.maximum(inputs @ self._hidden.T, 0.0) @ self._target.T
        missing = wanted - hidden @ self._learned.T
        step = missing.T @ hidden / len(hidden)
        self._learned += 0.5 * step / max(float((hidden * hidden).sum(axis=1).mean()), 1e-12)
        return float((missing * missing).mean())


def _largest(s: Situation, values: FloatArray) -> tuple[int, bool]:
    """Take the stream with the largest value, streams without a value first."""
    known = np.where(np.isfinite(values), values, np.inf)
    return exploring(lambda s: np.where(s.learning, known, -np.inf))(s)


def _robin(s: Situation, surprise: FloatArray) -> tuple[int, bool]:
    """Take the next stream that is being learned; any next one where none is."""
    turn = (s.stream + 1 + np.arange(len(s.learning))) % len(s.learning)
    return int((turn[s.learning[turn]] if s.learning.any() else turn)[0]), False


def _absolute_progress(s: Situation, surprise: FloatArray) -> tuple[int, bool]:
    """Absolute learning progress, drawn in proportion (ALP-GMM, Portelas et al. 2019).

    Streams have no distance from one another, so that each is a Gaussian of its own.
    """
    streams = np.flatnonzero(s.learning) if s.learning.any() else np.arange(len(s.learning))
    if s.draws[0] < 0.2 or not s.learning.any():
        return s.drawn(streams), True
    if short := [k for k in streams if len(s.errors.get(k, ())) < ERROR_BLOCKS]:
        return int(short[0]), False
    values = np.array(
        [
            abs(s.errors[k][:PROGRESS_BLOCKS].mean() - s.errors[k][PROGRESS_BLOCKS:].mean())
            for k in streams
        ]
    )
    place = int(np.searchsorted(np.cumsum(values), s.draws[1] * values.sum(), "right"))
    return int(streams[min(place, len(streams) - 1)]), False


RULES: dict[str, Callable[[Situation, FloatArray], tuple[int, bool]]] = {
    "robin": _robin,
    "alp": _absolute_progress,
    # Curiosity for prediction errors (ICM, Pathak et al. 2017), for novelty, and for errors that
    # fall below their mean before (learning progress monitoring, Hou et al. 2025).
    "prediction": lambda s, surprise: _largest(s, surprise[:, PROGRESS_BLOCKS:].mean(axis=1)),
    "rnd": lambda s, surprise: _largest(s, surprise[:, PROGRESS_BLOCKS:].mean(axis=1)),
    "lpm": lambda s, surprise: _largest(
        s, surprise[:, :PROGRESS_BLOCKS].mean(axis=1) - surprise[:, PROGRESS_BLOCKS:].mean(axis=1)
    ),
}
"""Every rule by its name."""
