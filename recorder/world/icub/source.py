"""`IcubSource`: the iCub scene as a source of frames; only the attended view is rendered."""

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

# Columns of ground truth: the objects' positions in the paper's coordinates, metres.
TRUTH = tuple(f"object{i}_{axis}" for i in (1, 2, 3) for axis in "xy")

# Further columns if physics moves the objects: heights of their centres in the root frame (m).
HEIGHTS = tuple(f"object{i}_z" for i in (1, 2, 3))

# Column with the factor of drifting light.
LIGHT = "light"


class IcubSource(ClockedSource):
    """Source of the images of the robot's eyes in a scene, rendered on demand.

    Raises:
        CdmisfaError: the simulator is not installed.
        UsageError: the scene cannot be built.
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
        truth = [*TRUTH, *(HEIGHTS if scene.physics else ())]
        truth += [LIGHT] * bool(scene.drift) + [YAW] * scene.roam
        self._spec = SourceSpec(
            scene.views, self._eyes.shape, "uint8", tuple(truth), record.fps, record.start_ns
        )

    @property
    def head_poses(self) -> Sequence[HeadPose]:
        """Pose of the head in each view except a roaming one."""
        (x, y, z), eyes = self._world.neck.tolist(), self._scene.eyes
        return [HeadPose((x, y, z), quaternion(yaw, eyes.pitch)) for yaw in eyes.yaw]

    @property
    def turns(self) -> tuple[tuple[int, ...], ...]:
        """Number of frames that each change of view loses; see `turn_to`."""
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
        """Return the kind, the seed and the configuration of the scene."""
        return {"kind": "icub", "seed": self._seed, "scene": section_table(self._scene)}

    def close(self) -> None:
        """End the simulator."""
        self._world.close()
        if isinstance(self._motions, PhysicalMotions):
            self._motions.close()
