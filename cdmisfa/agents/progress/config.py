"""What the progress learner can be told: keys `learner.*` of `learner.algorithm = "progress"`."""

from __future__ import annotations

from dataclasses import dataclass

from cdmisfa.core.config import (
    MAX_COMPONENTS,
    MAX_TAU,
    convert_fields,
    in_range,
    one_of,
    outputs_within_components,
    positive,
)

ATTENTIONS = ("novel", "progress", "random")
"""Rules that choose the stream to watch, see `attention`."""


@dataclass(frozen=True, slots=True)
class ProgressConfig:
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

    algorithm: str = "progress"
    tau: int = 40
    components: int = 16
    outputs: int = 8
    expansion: str | None = None
    window: int = 8000
    attention: str = "novel"
    visit: int = 5
    explore: float = 0.1
    test_frames: int = 2000
    settled: float = 0.03
    agreement: float = 0.25
    slow: float = 0.75
    even: float = 0.85
    looks: int = 2
    watch: int = 0

    def __post_init__(self) -> None:
        convert_fields(self, "learner")
        if self.expansion is not None:
            from cdmisfa.core.expansion import EXPANSIONS  # the keys alone are told without numpy

            one_of(self, "learner", EXPANSIONS, "expansion")
        one_of(self, "learner", ATTENTIONS, "attention")
        positive(self, "learner", "components", "outputs", "visit", "test_frames")
        positive(self, "learner", "window", "settled", "agreement", "looks")
        in_range(self, "learner", 0.0, 1.0, "explore", "slow", "even")
        in_range(self, "learner", 0.0, float(2**62), "watch")
        in_range(self, "learner", 1, MAX_COMPONENTS, "components")
        in_range(self, "learner", 3, MAX_TAU, "tau")
        outputs_within_components(self, "learner")
