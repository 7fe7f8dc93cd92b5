"""Attention: the rules that choose the next stream, by the name `learner.attention`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray

HALF = 8
"""Blocks of each half of the errors that progress is computed from."""

RECENT = 2 * HALF
"""Blocks whose learning errors a rule gets."""


@dataclass(frozen=True, slots=True)
class Situation:
    """What a rule decides by.

    Attributes:
        stream: the stream that was watched last.
        learning: (S,) whether each stream is being learned, and may be watched now.
        changed: (S,) whether it had been learned before, and no longer shows that.
        errors: recent learning errors of each stream that has a candidate, the newest last.
        visits: (S,) blocks that each stream was watched so far.
        draws: (2,) uniform in [0, 1): whether to explore, and which stream.
        explore: probability of any stream, of the rules that explore.
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
        """A stream drawn at random."""
        return self.drawn(np.arange(len(self.learning)))

    def drawn(self, streams: NDArray[np.intp]) -> int:
        """Return one of some streams, drawn at random."""
        return int(streams[min(int(self.draws[1] * len(streams)), len(streams) - 1)])


Rule = Callable[[Situation], tuple[int, bool]]
"""Returns the next stream, and whether it was drawn at random."""


def relative_progress(errors: FloatArray) -> float:
    """Return the fall of the learning error over the last blocks, larger where nearly done.

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
    """Return (S,) `relative_progress` of each stream, 0 where it is not being learned."""
    values = np.where(situation.learning, relative_progress(np.zeros(0)), 0.0)
    for stream, errors in situation.errors.items():
        if situation.learning[stream]:
            values[stream] = relative_progress(errors)
    return values


def exploring(value: Callable[[Situation], FloatArray]) -> Rule:
    """Return the rule that takes the largest value or, with a probability, any stream."""

    def choose(s: Situation) -> tuple[int, bool]:
        if s.draws[0] < s.explore or not s.learning.any():
            return s.any_stream, True
        return int(np.argmax(value(s))), False

    return choose


def _while_novel(s: Situation) -> tuple[int, bool]:
    """Stay with a stream until it is decided, changed ones first; rarely look at a decided one."""
    decided = np.flatnonzero(~s.learning)
    if not s.learning.any() or (s.draws[0] < s.explore and len(decided)):
        return s.drawn(decided), True
    begun = np.where(s.learning, s.visits, -1)
    return int(np.argmax(np.where(s.changed, begun + s.visits.sum(), begun))), False


RULES: Mapping[str, Rule] = {
    "novel": _while_novel,
    "progress": exploring(interest),
    "random": lambda s: (s.any_stream, True),
}
"""Every rule by its name."""
