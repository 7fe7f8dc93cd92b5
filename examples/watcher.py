"""A learner of your own: it attends to the streams in turn and stores the mean of all frames.

Run it with its module and class name:

    PYTHONPATH=examples cdmisfa learn oscillatory --algorithm watcher:Watcher -o runs/watcher
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.agents.inputs import signals_of_block
from cdmisfa.core.blocks import Block, SourceSpec
from cdmisfa.core.learning import LearnerState, overwrite
from cdmisfa.core.signals import BlockSignals
from cdmisfa.modules import Module


@dataclass(frozen=True)
class WatcherConfig:
    """Configuration keys `learner.*`. Only `algorithm` is required."""

    algorithm: str = "watcher:Watcher"
    tau: int = 30
    patience: int = 50


class Watcher:
    """A learner with the members of `cdmisfa.core.learning.Learner`."""

    configuration = WatcherConfig
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
        """Return the number of blocks so far."""
        return int(self._count[0])

    @property
    def stream(self) -> int:
        """Return the index of the stream to attend to next."""
        return self.iteration % len(self.spec.streams)

    @property
    def phi(self) -> NDArray[np.float64]:
        """Return the weights, (outputs, inputs), for the log."""
        return self._mean.copy()

    @property
    def over(self) -> str:
        """Return the reason why learning ends, or "" to continue."""
        return "nothing_left" if self.iteration >= self.config.patience else ""

    def step(self, block: Block) -> BlockSignals:
        """Learn from a block and return its signals; the signals not given here are NaN."""
        if (block.stream, len(block)) != (self.stream, self.tau):
            raise ValueError(f"{self.tau} frames of stream {self.stream} are needed")
        mean = block.frames.reshape(len(block), -1).mean(axis=0)
        change = float(np.abs(mean - self._mean[0]).mean())
        iteration = self.iteration
        self._mean[0] += (mean - self._mean[0]) / (iteration + 1)
        self._count += 1
        values = {"reward": change, "next_stream": self.stream}
        return signals_of_block(block, self.spec, iteration, outputs=1, modules=0, **values)

    @property
    def state(self) -> LearnerState:
        """Return a copy of all state that a resumed run needs."""
        arrays = {"mean": self._mean.copy(), "count": self._count.copy()}
        return LearnerState(arrays, (), self._rng.bit_generator.state)

    def restore(self, state: LearnerState) -> None:
        """Continue from a copy of the state."""
        overwrite({"mean": self._mean, "count": self._count}, state.arrays)
        self._rng.bit_generator.state = dict(state.policy_rng)

    def summary(self) -> Mapping[str, Any]:
        """Return further keys for `learn --json` and run.json."""
        return {"mean": self._mean[0].tolist()}
