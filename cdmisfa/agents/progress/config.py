"""`ProgressConfig`: the configuration keys of the progress learner and their defaults."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from cdmisfa.core.config import MAX_COMPONENTS, MAX_TAU, Section, key


@dataclass(frozen=True, slots=True)
class ProgressConfig(Section):
    """Configuration of the progress learner (keys `learner.*`).

    The defaults are those of the preset `cameras`. No value depends on the units, the contrast or
    the noise of a camera.

    Attributes:
        algorithm: `progress`.
        tau: block length in frames.
        components: number of principal components that are whitened for each stream. The learner
            tracks twice as many. Decisions use the slowest feature of these.
        outputs: number of slow features of a module.
        principal: number of principal components of a module, after its slow features; at most
            `components` are used.
        wide: number of components of the slow features after the first, from the moment at which
            a stream promises to be learned; at most `components`: no more than these.
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
    principal: int = key(8, 0, MAX_COMPONENTS)
    wide: int = key(48, 0, MAX_COMPONENTS)
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
