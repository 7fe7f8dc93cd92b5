"""What the progress learner can be told: keys `learner.*` of `learner.algorithm = "progress"`."""

from __future__ import annotations

from dataclasses import dataclass

from cdmisfa.core.config import (
    MAX_COMPONENTS,
    MAX_TAU,
    convert_fields,
    positive,
    within,
)
from cdmisfa.core.errors import UsageError
from cdmisfa.core.registry import did_you_mean

ATTENTIONS = ("progress", "random", "robin", "novel", "sticky", "gamma", "ucb")
"""How the stream to watch is chosen, see `attention`."""


@dataclass(frozen=True, slots=True)
class ProgressConfig:
    """Everything the progress learner can be told; the defaults are those of `cameras`.

    No value depends on the units, the contrast or the noise of a camera.
    """

    algorithm: str = "progress"
    tau: int = 40
    components: int = 16
    outputs: int = 1
    expansion: str | None = None
    window: int = 8000
    attention: str = "progress"
    visit: int = 5
    explore: float = 0.1
    test_frames: int = 800
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

            if self.expansion not in EXPANSIONS:
                hint = did_you_mean(self.expansion, EXPANSIONS)
                raise UsageError(f"learner.expansion is {self.expansion}: {hint}")
        if self.attention not in ATTENTIONS:
            hint = did_you_mean(self.attention, ATTENTIONS)
            raise UsageError(f"learner.attention is {self.attention}: {hint}")
        positive(self, "learner", "components", "outputs", "visit", "test_frames")
        positive(self, "learner", "window", "settled", "agreement", "looks")
        within(self, "learner", 0.0, 1.0, "explore", "slow", "even")
        within(self, "learner", 0.0, float(2**62), "watch")
        within(self, "learner", 1, MAX_COMPONENTS, "components")
        within(self, "learner", 3, MAX_TAU, "tau")
        if self.outputs > self.components:
            raise UsageError(
                f"learner.outputs is {self.outputs}, more than learner.components {self.components}"
            )
