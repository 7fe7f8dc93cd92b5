"""Objects that slide and roll over the table, drawn by magnets that move as the paper says.

The physics is a server of its own, stepped frame after frame from the first on; where the objects
were is kept, so that going back costs nothing.
"""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np

from cdmisfa.core.arrays import FloatArray
from recorder.world.icub.config import IcubConfig
from recorder.world.icub.world import Motions, silenced, start_simulator

STEPS = 30
"""Steps of 1/240 s in a frame: the objects have an eighth of a second to follow."""

_AHEAD = 64
"""Frames stepped at a time."""

_DIGITS = 5
"""Decimals of a pose: those beyond differ with the processor's sine and cosine."""

_MASSES = (0.25, 0.3, 0.15)
_FORCE = 12.0
"""Of a magnet at most, newtons."""

_PRESS = 0.002
"""Metres that a magnet is too low: it holds its object on the table, where the ball rolls."""

_FRICTION, _OF_TABLE = 0.4, 0.5


class PhysicalMotions:
    """Where the objects of a scene are as they follow `Motions`.

    Box and cylinder never tip or turn, as if led by a rail: tumbling is chaos, which ends
    differently on every kind of processor. The ball rolls.
    """

    def __init__(self, scene: IcubConfig, seed: int) -> None:
        self._targets, self._top, self._kept = Motions(scene, seed), scene.table.top, 0
        self._blocks: list[FloatArray] = []
        with silenced():
            self._bullet, _ = start_simulator()
        bullet, box, cylinder, ball = self._bullet, scene.object1, scene.object2, scene.object3
        bullet.setGravity(0, 0, -9.81)
        bullet.setPhysicsEngineParameter(fixedTimeStep=1 / 240, deterministicOverlappingPairs=1)
        table = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=(3.0, 3.0, 0.1))
        body = bullet.createMultiBody(0, table, basePosition=(0, 0, self._top - 0.1))
        bullet.changeDynamics(body, -1, lateralFriction=_OF_TABLE)
        shapes: tuple[tuple[Any, float], ...] = (
            ({"shapeType": bullet.GEOM_BOX, "halfExtents": (box.half_size,) * 3}, box.half_size),
            (
                {
                    "shapeType": bullet.GEOM_CYLINDER,
                    "radius": cylinder.radius,
                    "height": cylinder.height,
                },
                cylinder.height / 2,
            ),
            ({"shapeType": bullet.GEOM_SPHERE, "radius": ball.radius}, ball.radius),
        )
        starts = self._targets.positions(0, 1)[0].tolist()
        self._bodies = [
            self._body(*shape, mass, place, rolls=shape is shapes[2])
            for shape, mass, place in zip(shapes, _MASSES, starts, strict=True)
        ]

    def positions(self, start: int, n: int) -> FloatArray:
        """(n, objects, 7) poses at n frames from `start` on.

        X and y in the paper's coordinates, z, and the quaternion in the root frame.
        """
        while self._kept < start + n:
            self._blocks.append(self._step(self._kept))
            self._kept += _AHEAD
        first, last = start // _AHEAD, -(-(start + n) // _AHEAD)
        found = np.concatenate(self._blocks[first:last])
        return found[start - first * _AHEAD :][:n]

    def close(self) -> None:
        """End the simulator; harmless when called twice."""
        with contextlib.suppress(self._bullet.error):
            self._bullet.disconnect()

    def _body(
        self, shape: dict[str, Any], half: float, mass: float, place: list[float], *, rolls: bool
    ) -> tuple[int, int, float]:
        """An object, the magnet that draws it, and the height of that."""
        bullet, (x, y) = self._bullet, place
        body = bullet.createMultiBody(
            mass, bullet.createCollisionShape(**shape), basePosition=(x, -y, self._top + half)
        )
        bullet.changeDynamics(body, -1, lateralFriction=_FRICTION, linearDamping=0.0)
        if not rolls:
            bullet.changeDynamics(body, -1, localInertiaDiagonal=(0.0, 0.0, 0.0))
        # It draws the ball at its middle; what slides, near the table, so that it stays there.
        low = 0.0 if rolls else -0.8 * half
        height = self._top + half + low - _PRESS
        magnet = bullet.createConstraint(
            *(body, -1, -1, -1, bullet.JOINT_POINT2POINT),
            *((0, 0, 0), (0, 0, low), (x, -y, height)),
        )
        return body, magnet, height

    def _step(self, start: int) -> FloatArray:
        """Poses at the next frames, which start there."""
        bullet, poses = self._bullet, np.empty((_AHEAD, len(self._bodies), 7))
        for targets, row in zip(self._targets.positions(start, _AHEAD), poses, strict=True):
            for (_, magnet, height), (x, y) in zip(self._bodies, targets.tolist(), strict=True):
                bullet.changeConstraint(magnet, (x, -y, height), maxForce=_FORCE)
            for _ in range(STEPS):
                bullet.stepSimulation()
            for (body, _, _), pose in zip(self._bodies, row, strict=True):
                (x, y, z), turn = bullet.getBasePositionAndOrientation(body)
                pose[:] = [round(part, _DIGITS) for part in (x, -y, z, *turn)]
                # It goes on from what was rounded, so that what differs does not add up.
                speeds = bullet.getBaseVelocity(body)
                x, y, *rest = pose.tolist()
                bullet.resetBasePositionAndOrientation(body, (x, -y, rest[0]), rest[1:])
                bullet.resetBaseVelocity(
                    body, *([round(part, _DIGITS) for part in speed] for speed in speeds)
                )
        return poses
