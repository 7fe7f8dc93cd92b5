"""The configuration of the progress learner, and the rules that choose the next stream.

The keys are `learner.*` of `learner.algorithm = "progress"`; `learner.attention` names the rule.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.config import MAX_COMPONENTS, MAX_TAU, Section, key

# Blocks of each half of the errors that progress is computed from.
HALF = 8

# Blocks whose learning errors a rule gets.
RECENT = 2 * HALF


@dataclass(frozen=True, slots=True)
class ProgressConfig(Section):
    """Configuration of the progress learner (keys `learner.*`).

    The defaults are those of the preset `cameras`. No value depends on the units, the contrast or
    the noise of a camera.

    Attributes:
        algorithm: `progress`.
        tau: block length in frames.
        components: number of principal components that are whitened for each stream. The learner
            tracks twice as many.
        outputs: number of slow features of a module. Decisions use the slowest one.
        expansion: `none`, `quadratic` to add all products of two inputs, or `auto`: quadratic if
            all products fit into `components` (up to 4 values a frame), else none.
        window: exponential window of the statistics of a stream (frames).
        attention: rule that chooses the next stream: `novel`, `progress` or `random`.
        visit: smallest number of blocks for which the learner stays with a stream that it learns.
        explore: probability with which `novel` and `progress` choose a random stream instead.
        test_frames: window of the tests on frames before they are learned from (frames; at least
            20 blocks).
        settled: mean change of the output in a block below which the output has settled.
        agreement: largest difference between the slowness on new frames and on learned frames, as
            |ln| of their ratio, with which a module is saved.
        slow: slowness on new frames, relative to the typical slowness of the stream, below which a
            feature counts as slow.
        even: the same ratio, above which the stream is rejected because nothing in it is slow.
        looks: number of attempts at a stream before its rejection is final.
        watch: number of blocks to continue after every stream is decided, to notice changes.
    """

    prefix: ClassVar[str] = "learner"
    algorithm: str = "progress"
    tau: int = key(40, 3, MAX_TAU)
    components: int = key(16, 1, MAX_COMPONENTS)
    outputs: int = key(8, 1, "components")
    expansion: str | None = None
    window: int = key(8000, 1)
    attention: Literal["novel", "progress", "random"] = "novel"
    visit: int = key(5, 1)
    explore: float = key(0.1, 0, 1)
    test_frames: int = key(2000, 1)
    settled: float = key(0.03, 0, above=True)
    agreement: float = key(0.25, 0, above=True)
    slow: float = key(0.75, 0, 1)
    even: float = key(0.85, 0, 1)
    looks: int = key(2, 1)
    watch: int = key(0, 0, 2**62)


@dataclass(frozen=True, slots=True)
class Situation:
    """The input of a rule.

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


# Returns the next stream, and whether it was drawn at random.
Rule = Callable[[Situation], tuple[int, bool]]


def relative_progress(errors: FloatArray) -> float:
    """Return the fall of the learning error over the last blocks, larger where nearly done.

    That is (max(0, before - now) / before + 0.001) / now, with before and now the means of the
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
    visits = np.where(s.learning, s.visits, -1)
    return int(np.argmax(np.where(s.changed, visits + s.visits.sum(), visits))), False


RULES: Mapping[str, Rule] = {
    "novel": _while_novel,
    "progress": exploring(interest),
    "random": lambda s: (s.any_stream, True),
}
