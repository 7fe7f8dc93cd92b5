"""The iCub scene as a `FrameSource`: only the watched view is rendered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cdmisfa.core.blocks import Block, ClockedSource, HeadPose, SourceSpec, check_request, freeze
from cdmisfa.core.config import section_table
from recorder.config import RecordConfig
from recorder.world.icub.config import IcubConfig
from recorder.world.icub.eyes import Eyes
from recorder.world.icub.furnished import FurnishedEyes
from recorder.world.icub.head import YAW, Roaming, quaternion, turns
from recorder.world.icub.lens import light
from recorder.world.icub.motions import Motions, PhysicalMotions
from recorder.world.icub.world import World

TRUTH = tuple(f"object{i}_{axis}" for i in (1, 2, 3) for axis in "xy")
"""Columns of ground truth: the objects' positions in the paper's coordinates, metres."""

HEIGHTS = tuple(f"object{i}_z" for i in (1, 2, 3))
"""More of them where physics moves the objects: heights of their middles, root frame, metres."""

LIGHT = "light"
"""Where the light drifts, its factor."""


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
        self._roaming = Roaming(scene.eyes.yaw, scene.transit, self._seed) if scene.roam else None
        told = ((HEIGHTS, scene.physics), ((LIGHT,), scene.drift), ((YAW,), scene.roam))
        truth = TRUTH + tuple(name for names, there in told if there for name in names)
        self._spec = SourceSpec(
            scene.views, self._eyes.shape, "uint8", truth, record.fps, record.start_ns
        )

    @property
    def head_poses(self) -> Sequence[HeadPose]:
        """The head's pose in each view in which it stands still."""
        (x, y, z), eyes = self._world.neck.tolist(), self._scene.eyes
        return [HeadPose((x, y, z), quaternion(yaw, eyes.pitch)) for yaw in eyes.yaw]

    @property
    def turns(self) -> tuple[tuple[int, ...], ...]:
        """Frames that are lost where another view is looked at; see `turn_to`."""
        scene = self._scene
        return turns(scene.eyes.yaw, scene.transit, roam=scene.roam)

    def take(self, stream: int, n: int) -> Block:
        """Render the next n frames of a view; see `FrameSource.take`."""
        check_request(self._spec, stream, n)
        scene, t = self._scene, self._t
        positions = self._motions.positions(t, n)
        roamed = [] if self._roaming is None else self._roaming.angles(t, n)
        yaws = scene.eyes.yaw
        angles = [yaws[stream]] * n if stream < len(yaws) else roamed
        truth = [positions[..., :2].reshape(n, -1), positions[..., 2:3].reshape(n, -1)]
        if scene.drift:
            truth.append(light(scene.drift, t, n)[:, None])
        if scene.roam:
            truth.append(np.array(roamed)[:, None])
        frames = self._eyes.look(stream, t, positions, angles)
        self._t += n
        return Block(stream, t, freeze(frames), freeze(np.concatenate(truth, axis=1)))

    def describe(self) -> Mapping[str, Any]:
        """The scene's seed and everything it was built from."""
        return {"kind": "icub", "seed": self._seed, "scene": section_table(self._scene)}

    def close(self) -> None:
        """End the simulator."""
        self._world.close()
        if isinstance(self._motions, PhysicalMotions):
            self._motions.close()
