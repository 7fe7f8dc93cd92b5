"""Attention rules: how the progress learner chooses the stream of the next block.

`learner.attention` names one of `RULES`; a program can assign any other `Rule` to
`ProgressLearner.rule`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray

# Blocks in each of the two means that learning progress compares. Chosen on the benchmark seeds
# 100 to 103 (decision 0027 of docs/project/decisions.md). A larger number smooths the progress, and
# a new stream is preferred for longer because it has no two means yet.
PROGRESS_BLOCKS = 8

# Learning errors that a rule receives for each stream: enough for both means.
ERROR_BLOCKS = 2 * PROGRESS_BLOCKS

# Added to the relative fall of the error, so that a stream without progress keeps a little
# interest, and smallest error to divide by. Both are far below the errors of a stream that is still
# being learned (0.1 to 3), so that their exact value does not matter.
MIN_PROGRESS = MIN_ERROR = 1e-3

# Interest of a stream that has fewer than ERROR_BLOCKS errors, at least. With the factor that is
# applied to it, it exceeds 1,001, the largest relative progress, so that new streams come first.
NEW_STREAM_INTEREST = 1e3


@dataclass(frozen=True, slots=True)
class Situation:
    """The input of an attention rule, for S streams.

    Attributes:
        stream: index of the stream of the last block.
        learning: (S,) True where a stream is being learned and can be attended to now.
        changed: (S,) True where a stream had a module before and no longer matches it.
        errors: recent learning errors of each stream that has a candidate, the newest last.
        visits: (S,) number of blocks that were taken from each stream.
        draws: (2,) uniform numbers in [0, 1): whether to explore, and which stream.
        explore: probability that a rule draws a stream at random.
    """

    stream: int
    learning: NDArray[np.bool_]
    changed: NDArray[np.bool_]
    errors: Mapping[int, FloatArray]
    visits: NDArray[np.int64]
    draws: FloatArray
    explore: float

    @property
    def any_stream(self) -> int:
        """Index of a stream drawn at random from all streams."""
        return self.drawn(np.arange(len(self.learning)))

    def drawn(self, streams: NDArray[np.intp]) -> int:
        """Return one of the given stream indices, drawn at random."""
        return int(streams[min(int(self.draws[1] * len(streams)), len(streams) - 1)])


# Returns the index of the next stream, and whether it was drawn at random.
Rule = Callable[[Situation], tuple[int, bool]]


def relative_progress(errors: FloatArray) -> float:
    """Return the relative fall of the learning error divided by the error itself.

    The result is (max(0, before - now) / before + 0.001) / now, where `now` is the mean of the last
    8 learning errors and `before` the mean of the 8 errors before these. Dividing by the error
    prefers streams that are nearly learned.

    Equation: P3

    Args:
        errors: learning errors, the newest last. With fewer than 16 errors the result is at least
            1,000, more than any other stream has; the fewer errors, the larger.
    """
    if len(errors) < ERROR_BLOCKS:
        return NEW_STREAM_INTEREST * (1.0 + 1.0 / (1.0 + len(errors)))
    before = float(errors[-ERROR_BLOCKS:-PROGRESS_BLOCKS].mean())
    now = float(errors[-PROGRESS_BLOCKS:].mean())
    fall = max(0.0, before - now) / max(before, 1e-9)
    return (fall + MIN_PROGRESS) / max(now, MIN_ERROR)


def interest(situation: Situation) -> FloatArray:
    """Return (S,) `relative_progress` of each stream, 0 where it is not being learned."""
    values = np.where(situation.learning, relative_progress(np.zeros(0)), 0.0)
    for stream, errors in situation.errors.items():
        if situation.learning[stream]:
            values[stream] = relative_progress(errors)
    return values


def exploring(value: Callable[[Situation], FloatArray]) -> Rule:
    """Return the rule that takes the stream of the largest value or, sometimes, any stream.

    Args:
        value: returns (S,) the value of each stream.
    """

    def choose(s: Situation) -> tuple[int, bool]:
        if s.draws[0] < s.explore or not s.learning.any():
            return s.any_stream, True
        return int(np.argmax(value(s))), False

    return choose


def _until_decided(s: Situation) -> tuple[int, bool]:
    """Stay with a stream until it is decided; take changed streams first.

    A decided stream is drawn with probability `explore`, so that a change of it is noticed.
    """
    decided = np.flatnonzero(~s.learning)
    if not s.learning.any() or (s.draws[0] < s.explore and len(decided)):
        return s.drawn(decided), True
    visits = np.where(s.learning, s.visits, -1)
    return int(np.argmax(np.where(s.changed, visits + s.visits.sum(), visits))), False


RULES: Mapping[str, Rule] = {
    "novel": _until_decided,
    "progress": exploring(interest),
    "random": lambda s: (s.any_stream, True),
}
