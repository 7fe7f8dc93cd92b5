"""What the progress learner can be told: keys `learner.*` of `learner.algorithm = "progress"`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from cdmisfa.core.config import MAX_COMPONENTS, MAX_TAU, Section, key


@dataclass(frozen=True, slots=True)
class ProgressConfig(Section):
    """Everything the progress learner can be told; the defaults are those of `cameras`.

    No value depends on the units, the contrast or the noise of a camera.

    Attributes:
        algorithm: `progress`.
        tau: frames of one block.
        components: principal components whitened for each stream; twice as many are kept.
        outputs: slow features of one module; the slowest is judged.
        expansion: `none`, `quadratic`, or `auto`: quadratic where `components` hold all of it
            (frames of 4 values), else none.
        window: exponential window of the statistics of a stream (frames).
        attention: rule that chooses the stream to watch: `novel`, `progress` or `random`.
        visit: blocks that a stream being learned is watched at least.
        explore: probability of any stream at a choice, of the rules that explore.
        test_frames: window of the tests on frames not yet learned from; at least 20 blocks
            (frames).
        settled: mean change of the output with a block, below which it is settled.
        agreement: most that tested and fitted slowness may differ, |ln| of their ratio.
        slow: tested slowness over the stream's typical one, below which something in it is slow.
        even: the same, above which nothing is.
        looks: how often a stream is tried before it is given up for good.
        watch: blocks to watch on when every stream is decided, in case one changes.
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
