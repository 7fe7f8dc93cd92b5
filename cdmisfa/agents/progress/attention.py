"""Where to look: the rules that choose the next stream, by the name `learner.attention`.

Those that others have found are brought down to what there is here: streams in place of tasks,
states or actions, and the learning error of each stream's candidate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cdmisfa import kernels
from cdmisfa.core.arrays import FloatArray

HALF = 8
"""Blocks of each half of the errors that progress is told from."""

RECENT = 2 * HALF
"""Blocks whose learning errors a rule is told."""

LEAVE = 0.2
"""Probability with which the rule `sticky` leaves a stream after a visit."""

AT_RANDOM = 0.2
"""Share of the choices of the rule `alp` that are drawn evenly."""


@dataclass(frozen=True, slots=True)
class Situation:
    """What a rule decides by.

    Attributes:
        stream: the one watched last.
        learning: (S,) whether each is being learned, and may be watched now.
        changed: (S,) whether it had been learned before, and no longer shows that.
        errors: the last learning errors of each stream whose candidate is held, the newest last.
        surprise: (S, n) what the rule measured of late on each stream, the newest last, NaN
            before; of the rules in `MEASURES`.
        visits: (S,) blocks each was watched so far.
        draws: (2,) uniform in [0, 1): whether to explore, and which.
        explore: probability of any stream, of the rules that explore.
    """

    stream: int
    learning: NDArray[np.bool_]
    changed: NDArray[np.bool_]
    errors: Mapping[int, FloatArray]
    surprise: FloatArray
    visits: NDArray[np.int64]
    draws: FloatArray
    explore: float

    @property
    def any_stream(self) -> int:
        """A stream drawn at random."""
        return self.drawn(np.arange(len(self.learning)))

    def drawn(self, streams: NDArray[np.intp]) -> int:
        """One of some streams, drawn at random."""
        return int(streams[min(int(self.draws[1] * len(streams)), len(streams) - 1)])


Rule = Callable[[Situation], tuple[int, bool]]
"""The next stream, and whether it was drawn at random."""


def relative_progress(errors: FloatArray) -> float:
    """Fall of the learning error over the last blocks, weighted towards what is nearly done.

    That is (max(0, before - now) / before + .001) / now, with before and now the means of the
    learning error over the last but one and the last 8 blocks.

    Equation: P3

    Args:
        errors: learning errors, the newest last; with fewer than 16 of them a stream promises
            more than any other, and most with none.
    """
    if len(errors) < RECENT:
        return 1e3 * (1.0 + 1.0 / (1.0 + len(errors)))
    before, now = float(errors[-RECENT:-HALF].mean()), float(errors[-HALF:].mean())
    fall = max(0.0, before - now) / max(before, 1e-9)
    return (fall + 1e-3) / max(now, 1e-3)


def interest(situation: Situation) -> FloatArray:
    """(S,) `relative_progress` of each stream, 0 of those that are not being learned."""
    return _of_each(situation, lambda errors, _: relative_progress(errors), 0.0)


def _of_each(
    s: Situation, value: Callable[[FloatArray, int], float], otherwise: float
) -> FloatArray:
    """(S,) the value of each stream by its errors and visits, another where it is not learned."""
    values = np.where(s.learning, value(np.zeros(0), 0), otherwise)  # without a candidate
    for stream, errors in s.errors.items():
        if s.learning[stream]:
            values[stream] = value(errors, int(s.visits[stream]))
    return values


def _exploring(value: Callable[[Situation], FloatArray]) -> Rule:
    """The stream of the largest value; with a probability, or where all is learned, any."""

    def choose(s: Situation) -> tuple[int, bool]:
        if s.draws[0] < s.explore or not s.learning.any():
            return s.any_stream, True
        return int(np.argmax(value(s))), False

    return choose


def _gamma_progress(s: Situation) -> FloatArray:
    """Slow mean of the learning error less its fast mean (Kim et al. 2020)."""

    def value(errors: FloatArray, _: int) -> float:
        if len(errors) < RECENT:
            return 1e3
        slow, fast = fading(0.95, len(errors)), fading(0.7, len(errors))
        return float((errors * slow).sum() / slow.sum() - (errors * fast).sum() / fast.sum())

    return _of_each(s, value, -1e3)


def fading(base: float, n: int) -> FloatArray:
    """N >= 1 weights, from base^(n-1) to 1."""
    return np.asarray(np.multiply.accumulate(np.append(1.0, np.full(n - 1, base)))[::-1])


def _upper_bound(s: Situation) -> FloatArray:
    """Upper confidence bound on the relative fall of the learning error (UCB1)."""
    total = kernels.log(max(int(s.visits.sum()), 2))

    def value(errors: FloatArray, visits: int) -> float:
        if len(errors) < RECENT:
            return 1e3
        before, now = float(errors[-RECENT:-HALF].mean()), float(errors[-HALF:].mean())
        fall = max(0.0, before - now) / max(before, 1e-9)
        return fall + math.sqrt(total / (2.0 * visits))

    return _of_each(s, value, -1e3)


def _robin(s: Situation) -> tuple[int, bool]:
    """The next stream that is being learned, of all where none is."""
    turn = (s.stream + 1 + np.arange(len(s.learning))) % len(s.learning)
    return int((turn[s.learning[turn]] if s.learning.any() else turn)[0]), False


def _while_novel(s: Situation) -> tuple[int, bool]:
    """A stream until it is decided, those first that have changed; now and then a decided one."""
    decided = np.flatnonzero(~s.learning)
    if not s.learning.any() or (s.draws[0] < s.explore and len(decided)):
        return s.drawn(decided), True
    begun = np.where(s.learning, s.visits, -1)
    return int(np.argmax(np.where(s.changed, begun + s.visits.sum(), begun))), False


def _sticky(s: Situation) -> tuple[int, bool]:
    return (s.stream, False) if s.draws[0] >= LEAVE else (s.any_stream, True)


def _absolute_progress(s: Situation) -> tuple[int, bool]:
    """Absolute learning progress, drawn in proportion (ALP-GMM, Portelas et al. 2019).

    Streams have no distance from one another, so that each is a Gaussian of its own.
    """
    streams = np.flatnonzero(s.learning) if s.learning.any() else np.arange(len(s.learning))
    if s.draws[0] < AT_RANDOM or not s.learning.any():
        return s.drawn(streams), True
    short = [k for k in streams if len(s.errors.get(int(k), ())) < RECENT]
    if short:
        return int(short[0]), False

    def value(errors: FloatArray, _: int) -> float:
        return abs(float(errors[:HALF].mean()) - float(errors[HALF:].mean()))

    sums = np.add.accumulate(_of_each(s, lambda e, n: value(e, n) if len(e) else 0.0, 0.0))
    return int(min(np.searchsorted(sums, s.draws[1] * sums[-1], "right"), streams[-1])), False


def _monitored(s: Situation) -> FloatArray:
    """Fall of the prediction error below what it was (learning progress monitoring, Hou 2025).

    The error of the model before is expected to be its mean over the blocks before the last.
    """
    before, now = s.surprise[:, :HALF].mean(axis=1), s.surprise[:, HALF:].mean(axis=1)
    return _of_learned(s, before - now)


def _surprising(s: Situation) -> FloatArray:
    """What was measured of late: the prediction error (as ICM, Pathak et al. 2017), or novelty."""
    return _of_learned(s, s.surprise[:, HALF:].mean(axis=1))


def _of_learned(s: Situation, values: FloatArray) -> FloatArray:
    """(S,) values; most of those that were watched too little, none of what is not learned."""
    return np.where(s.learning, np.where(np.isfinite(values), values, np.inf), -np.inf)


RULES: Mapping[str, Rule] = {
    "progress": _exploring(interest),
    "random": lambda s: (s.any_stream, True),
    "robin": _robin,
    "novel": _while_novel,
    "sticky": _sticky,
    "gamma": _exploring(_gamma_progress),
    "ucb": lambda s: (int(np.argmax(_upper_bound(s))), False),
    "prediction": _exploring(_surprising),
    "rnd": _exploring(_surprising),
    "alp": _absolute_progress,
    "lpm": _exploring(_monitored),
}
"""Every rule by its name."""
