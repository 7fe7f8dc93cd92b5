"""A scene: two swings, of which one is slower."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cdmisfa.core.blocks import Block, ClockedSource, SourceSpec, check_request, freeze
from recorder import RecordConfig, Scene, SceneConfig


@dataclass(frozen=True)
class SwingConfig(SceneConfig):
    """Keys `scene.*`."""

    kind: str = "swings"
    period: float = 90.0


class Swings(ClockedSource):
    """Where each swing is, and noise that the seed decides."""

    def __init__(self, config: SwingConfig, clock: RecordConfig) -> None:
        self.config = config
        streams = ("quick", "slow")
        self._spec = SourceSpec(streams, (3,), "float64", ("angle",), clock.fps, clock.start_ns)

    def take(self, stream: int, n: int) -> Block:
        """See `FrameSource`."""
        check_request(self.spec, stream, n)
        t = np.arange(self._t, self._t + n)
        angle = 2 * np.pi * t / self.config.period
        mine = angle / (1 + stream)
        noise = [np.random.default_rng((self.config.seed or 0, stream, at)).random() for at in t]
        frames = np.stack([np.sin(mine), np.cos(9 * mine), noise], axis=1)
        block = Block(stream, self._t, freeze(frames), freeze(angle[:, None]))
        self._t += n
        return block

    def describe(self) -> Mapping[str, Any]:
        """The seed and the period decide every frame."""
        return {"kind": "swings", "seed": self.config.seed, "period": self.config.period}


SWINGS = Scene(
    SwingConfig, Swings, str(Path(__file__).with_name("swings.toml")), packages=("cdmisfa-toy",)
)
