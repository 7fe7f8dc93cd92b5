"""The iCub scene as a `FrameSource`: only the watched view is rendered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cdmisfa.core.blocks import Block, HeadPose, SeekableSource, SourceSpec, check_request, freeze
from cdmisfa.core.config import as_table
from recorder.config import RecordConfig
from recorder.world.icub.config import IcubConfig
from recorder.world.icub.eyes import Eyes
from recorder.world.icub.motions import Motions
from recorder.world.icub.world import World

TRUTH = tuple(f"object{i}_{axis}" for i in (1, 2, 3) for axis in "xy")
"""Columns of ground truth: the objects' positions in the paper's coordinates, metres."""


class IcubSource(SeekableSource):
    """What the robot's eyes see in a scene, rendered when it is asked for, on a clock.

    Raises:
        CdmisfaError: the simulator is not installed.
        UsageError: a scene that cannot be built.
    """

    def __init__(self, scene: IcubConfig, record: RecordConfig) -> None:
        self._scene = scene
        self._seed = scene.seed or 0
        self._motions = Motions(scene, self._seed)
        self._world = World(scene)
        self._eyes = Eyes(scene.eyes, self._world)
        self._spec = SourceSpec(
            scene.eyes.views, self._eyes.shape, "uint8", TRUTH, record.fps, record.start_ns
        )

    @property
    def spec(self) -> SourceSpec:
        """What the source delivers."""
        return self._spec

    @property
    def t(self) -> int:
        """Global counter of the next frame."""
        return self._motions.t

    @property
    def head_poses(self) -> Sequence[HeadPose]:
        """The head's pose in each view."""
        return self._eyes.poses()

    def take(self, stream: int, n: int) -> Block:
        """Render the next n frames of a view; see `FrameSource.take`."""
        check_request(self._spec, stream, n)
        t = self.t
        positions = self._motions.take(n)
        frames = np.empty((n, *self._spec.frame_shape), np.uint8)
        for frame, places in zip(frames, positions, strict=True):
            self._world.place(places)
            self._eyes.see(stream, frame)
        return Block(stream, t, freeze(frames), freeze(positions.reshape(n, -1)))

    def seek(self, t: int) -> None:
        """Move the clock to frame t."""
        self._motions.seek(t)

    def describe(self) -> Mapping[str, Any]:
        """The scene's seed and everything it was built from."""
        return {"kind": "icub", "seed": self._seed, "scene": as_table(self._scene)}

    def close(self) -> None:
        """End the simulator."""
        self._world.close()
