"""A learner: it watches one stream after the other, and keeps the mean of what it saw."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.agents.blank import signals_of_block
from cdmisfa.agents.learners import LearnerEntry
from cdmisfa.core.blocks import Block, SourceSpec
from cdmisfa.core.learning import LearnerState, overwrite
from cdmisfa.core.signals import BlockSignals
from cdmisfa.modules import Module


@dataclass(frozen=True)
class WatcherConfig:
    """Keys `learner.*`."""

    algorithm: str = "watcher"
    tau: int = 30
    patience: int = 50


class Watcher:
    """See `Learner`."""

    events: tuple[str, ...] = ()
    modules: tuple[Module, ...] = ()
    max_modules = None

    def __init__(self, config: WatcherConfig, spec: SourceSpec, seed: int) -> None:
        self.config, self.spec, self.tau = config, spec, config.tau
        self._rng = np.random.default_rng(seed)
        self._mean = np.zeros((1, int(np.prod(spec.frame_shape))))
        self._count = np.zeros(1, np.int64)

    @property
    def iteration(self) -> int:
        return int(self._count[0])

    @property
    def stream(self) -> int:
        return self.iteration % len(self.spec.streams)

    @property
    def phi(self) -> NDArray[np.float64]:
        return self._mean.copy()

    @property
    def over(self) -> str:
        return "nothing_left" if self.iteration >= self.config.patience else ""

    def step(self, block: Block) -> BlockSignals:
        if (block.stream, len(block)) != (self.stream, self.tau):
            raise ValueError(f"{self.tau} frames of stream {self.stream} are needed")
        seen = block.frames.reshape(len(block), -1).mean(axis=0)
        change = float(np.abs(seen - self._mean[0]).mean())
        iteration = self.iteration
        self._mean[0] += (seen - self._mean[0]) / (iteration + 1)
        self._count += 1
        said = {"reward": change, "next_stream": self.stream}
        return signals_of_block(block, self.spec, iteration, outputs=1, modules=0, **said)

    @property
    def state(self) -> LearnerState:
        arrays = {"mean": self._mean.copy(), "count": self._count.copy()}
        return LearnerState(arrays, (), self._rng.bit_generator.state)

    def restore(self, state: LearnerState) -> None:
        overwrite({"mean": self._mean, "count": self._count}, state.arrays)
        self._rng.bit_generator.state = dict(state.policy_rng)

    def summary(self) -> Mapping[str, Any]:
        return {"mean": self._mean[0].tolist()}


WATCHER = LearnerEntry(WatcherConfig, Watcher, str(Path(__file__).with_name("watcher.toml")))
