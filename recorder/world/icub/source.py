"""The iCub scene as a `FrameSource`: only the watched view is rendered."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cdmisfa.core.blocks import Block, ClockedSource, HeadPose, SourceSpec, check_request, freeze
from cdmisfa.core.config import section_table
from recorder.config import RecordConfig
from recorder.world.icub.config import IcubConfig
from recorder.world.icub.eyes import Eyes
from recorder.world.icub.furnished import FurnishedEyes
from recorder.world.icub.physics import PhysicalMotions
from recorder.world.icub.world import Motions, World

TRUTH = tuple(f"object{i}_{axis}" for i in (1, 2, 3) for axis in "xy")
"""Columns of ground truth: the objects' positions in the paper's coordinates, metres."""

HEIGHTS = tuple(f"object{i}_z" for i in (1, 2, 3))
"""More of them where physics moves the objects: heights of their middles, root frame, metres."""


class IcubSource(ClockedSource):
    """What the robot's eyes see in a scene, rendered when it is asked for, on a clock.

    Raises:
        CdmisfaError: the simulator is not installed.
        UsageError: a scene that cannot be built.
    """

    def __init__(self, scene: IcubConfig, record: RecordConfig) -> None:
        self._scene = scene
        self._seed = scene.seed or 0
        self._motions: Motions | PhysicalMotions = (
            PhysicalMotions(scene, self._seed) if scene.physics else Motions(scene, self._seed)
        )
        self._world = World(scene)
        self._eyes = (
            Eyes(scene.eyes, self._world) if scene.plain else FurnishedEyes(scene, self._world)
        )
        truth = TRUTH + HEIGHTS if scene.physics else TRUTH
        self._spec = SourceSpec(
            scene.eyes.views, self._eyes.shape, "uint8", truth, record.fps, record.start_ns
        )

    @property
    def head_poses(self) -> Sequence[HeadPose]:
        """The head's pose in each view."""
        x, y, z = self._world.neck.tolist()
        halves = [math.radians(yaw) / 2 for yaw in self._scene.eyes.yaw]
        return [HeadPose((x, y, z), (0.0, 0.0, math.sin(h), math.cos(h))) for h in halves]

    def take(self, stream: int, n: int) -> Block:
        """Render the next n frames of a view; see `FrameSource.take`."""
        check_request(self._spec, stream, n)
        positions = self._motions.positions(self._t, n)
        frames = self._eyes.look(stream, self._t, positions)
        truth = [positions[..., :2].reshape(n, -1), positions[..., 2:3].reshape(n, -1)]
        block = Block(stream, self._t, freeze(frames), freeze(np.concatenate(truth, axis=1)))
        self._t += n
        return block

    def describe(self) -> Mapping[str, Any]:
        """The scene's seed and everything it was built from."""
        return {"kind": "icub", "seed": self._seed, "scene": section_table(self._scene)}

    def close(self) -> None:
        """End the simulator."""
        self._world.close()
        if isinstance(self._motions, PhysicalMotions):
            self._motions.close()
