"""Positions of the objects: as the paper moves them, or as physics drags them after that.

The physics has a simulator of its own, which is stepped frame after frame. Its poses are stored, so
that going back is immediate.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np

from cdmisfa.core.arrays import FloatArray
from recorder.world.icub.config import BoxConfig, CylinderConfig, IcubConfig, Range, SphereConfig
from recorder.world.icub.world import silenced, start_simulator

# Frames drawn at a time. Another value changes the random walk of every seed.
CHUNK = 4096

# Spawn key of the world's generators under the seed; the learner has other keys.
_WORLD = 0x1C0B


def toggling_motion(config: BoxConfig, generator: np.random.Generator) -> Iterator[FloatArray]:
    """Yield chunks (CHUNK, 2): x uniform and independent; y toggles between two values."""
    for t in itertools.count(0, CHUNK):
        x = _uniform(generator.random(CHUNK), config.x)
        phase = (t + np.arange(CHUNK)) // config.toggle_every % 2
        yield np.stack([x, np.asarray(config.y)[phase]], axis=1)


def uniform_motion(config: CylinderConfig, generator: np.random.Generator) -> Iterator[FloatArray]:
    """Yield chunks (CHUNK, 2): x and y uniform and independent of the previous frame."""
    while True:
        units = generator.random((CHUNK, 2))
        yield np.stack([_uniform(units[:, 0], config.x), _uniform(units[:, 1], config.y)], axis=1)


def walking_motion(config: SphereConfig, generator: np.random.Generator) -> Iterator[FloatArray]:
    """Yield chunks (CHUNK, 2) of a Gaussian random walk, reflected at the borders."""
    borders = (config.x, config.y)
    last = np.stack([_uniform(generator.random(1), limits) for limits in borders], axis=1)
    for chunk in itertools.count():
        steps = generator.standard_normal((CHUNK, 2)) * (config.step_x, config.step_y)
        if chunk == 0:
            steps[0] = 0.0
        steps[0] += last[0]
        free = np.cumsum(steps, axis=0)
        path = np.stack([reflect(free[:, i], limits) for i, limits in enumerate(borders)], axis=1)
        last = path[-1:]
        yield path


def reflect(values: FloatArray, limits: Range) -> FloatArray:
    """Reflect a free walk (n,) at the limits."""
    low, high = limits
    width = high - low
    if width == 0:
        return np.full_like(values, low)
    return np.clip(low + width - np.abs((values - low) % (2 * width) - width), low, high)


class Motions:
    """Positions of all objects of a scene at every frame, for a seed."""

    def __init__(self, scene: IcubConfig, seed: int) -> None:
        self._scene, self._seed = scene, seed
        self._restart()

    def positions(self, start: int, n: int) -> FloatArray:
        """Return (n, objects, 2) x and y from frame `start` on, in the paper's coordinates (m)."""
        parts = []
        while n > 0:
            chunk, first = divmod(start, CHUNK)
            parts.append(self._draw(chunk)[first : first + n])
            start, n = start + len(parts[-1]), n - len(parts[-1])
        return np.concatenate(parts)

    def _draw(self, chunk: int) -> FloatArray:
        """Return the positions of a chunk; for an earlier one, draw from the start again."""
        if chunk < self._chunk:
            self._restart()
        while self._chunk < chunk:
            self._positions = np.stack([next(motion) for motion in self._motions], axis=1)
            self._chunk += 1
        return self._positions

    def _restart(self) -> None:
        seeds = [np.random.SeedSequence(self._seed, spawn_key=(_WORLD, i)) for i in range(3)]
        box, cylinder, sphere = (np.random.Generator(np.random.PCG64(seed)) for seed in seeds)
        self._motions = (
            toggling_motion(self._scene.object1, box),
            uniform_motion(self._scene.object2, cylinder),
            walking_motion(self._scene.object3, sphere),
        )
        self._chunk = -1


def _uniform(unit: FloatArray, limits: Range) -> FloatArray:
    return limits[0] + (limits[1] - limits[0]) * unit


# Physics steps of 1/240 s in a frame: the objects have 1/8 s to follow. These and the next
# constants are set by hand.
STEPS = 30

# Frames simulated at a time.
_AHEAD = 64

# Decimals of a pose; further ones differ with the processor's sine and cosine.
_DIGITS = 5

# Masses of box, cylinder and ball (kg).
_MASSES = (0.25, 0.3, 0.15)

# Largest force of a magnet (N).
_FORCE = 12.0

# Depth of a magnet below its object's centre (m): it presses the object to the table.
_PRESS = 0.002

# Friction of the objects and of the table.
_FRICTION, _TABLE_FRICTION = 0.4, 0.5


class PhysicalMotions:
    """Poses of the objects of a scene, which magnets drag after `Motions`.

    Box and cylinder cannot tip or turn: tumbling is chaotic, and differs between processors. The
    ball rolls.
    """

    def __init__(self, scene: IcubConfig, seed: int) -> None:
        self._targets, self._top, self._stored = Motions(scene, seed), scene.table.top, 0
        self._blocks: list[FloatArray] = []
        with silenced():
            self._bullet, _ = start_simulator()
        bullet, box, cylinder, ball = self._bullet, scene.object1, scene.object2, scene.object3
        bullet.setGravity(0, 0, -9.81)
        bullet.setPhysicsEngineParameter(fixedTimeStep=1 / 240, deterministicOverlappingPairs=1)
        table = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=(3.0, 3.0, 0.1))
        body = bullet.createMultiBody(0, table, basePosition=(0, 0, self._top - 0.1))
        bullet.changeDynamics(body, -1, lateralFriction=_TABLE_FRICTION)
        can = {"radius": cylinder.radius, "height": cylinder.height}
        shapes: tuple[tuple[Any, float], ...] = (
            ({"shapeType": bullet.GEOM_BOX, "halfExtents": (box.half_size,) * 3}, box.half_size),
            ({"shapeType": bullet.GEOM_CYLINDER, **can}, cylinder.height / 2),
            ({"shapeType": bullet.GEOM_SPHERE, "radius": ball.radius}, ball.radius),
        )
        starts = self._targets.positions(0, 1)[0].tolist()
        self._bodies = [
            self._body(*shape, mass, place, rolls=shape is shapes[2])
            for shape, mass, place in zip(shapes, _MASSES, starts, strict=True)
        ]

    def positions(self, start: int, n: int) -> FloatArray:
        """Return (n, objects, 7) poses from frame `start` on.

        A pose is x and y in the paper's coordinates, z, and the quaternion in the root frame.
        """
        while self._stored < start + n:
            self._blocks.append(self._step(self._stored))
            self._stored += _AHEAD
        first, last = start // _AHEAD, -(-(start + n) // _AHEAD)
        poses = np.concatenate(self._blocks[first:last])
        return poses[start - first * _AHEAD :][:n]

    def close(self) -> None:
        """End the simulator; a second call does nothing."""
        with contextlib.suppress(self._bullet.error):
            self._bullet.disconnect()

    def _body(
        self, shape: dict[str, Any], half: float, mass: float, place: list[float], *, rolls: bool
    ) -> tuple[int, int, float]:
        """Add an object; return it, the magnet that drags it, and the magnet's height."""
        bullet, (x, y) = self._bullet, place
        body = bullet.createMultiBody(
            mass, bullet.createCollisionShape(**shape), basePosition=(x, -y, self._top + half)
        )
        bullet.changeDynamics(body, -1, lateralFriction=_FRICTION, linearDamping=0.0)
        if not rolls:
            bullet.changeDynamics(body, -1, localInertiaDiagonal=(0.0, 0.0, 0.0))
        # The magnet acts at the centre of the ball, and low on what slides, so that it stays flat.
        low = 0.0 if rolls else -0.8 * half
        height = self._top + half + low - _PRESS
        magnet = bullet.createConstraint(
            *(body, -1, -1, -1, bullet.JOINT_POINT2POINT),
            *((0, 0, 0), (0, 0, low), (x, -y, height)),
        )
        return body, magnet, height

    def _step(self, start: int) -> FloatArray:
        """Simulate the next frames, and return the poses from frame `start` on."""
        bullet, poses = self._bullet, np.empty((_AHEAD, len(self._bodies), 7))
        for targets, row in zip(self._targets.positions(start, _AHEAD), poses, strict=True):
            for (_, magnet, height), (x, y) in zip(self._bodies, targets.tolist(), strict=True):
                bullet.changeConstraint(magnet, (x, -y, height), maxForce=_FORCE)
            for _ in range(STEPS):
                bullet.stepSimulation()
            for (body, _, _), pose in zip(self._bodies, row, strict=True):
                (x, y, z), turn = bullet.getBasePositionAndOrientation(body)
                pose[:] = [round(part, _DIGITS) for part in (x, -y, z, *turn)]
                # Continue from rounded values, so that differences between machines do not add up.
                speeds = bullet.getBaseVelocity(body)
                x, y, *rest = pose.tolist()
                bullet.resetBasePositionAndOrientation(body, (x, -y, rest[0]), rest[1:])
                bullet.resetBaseVelocity(
                    body, *([round(part, _DIGITS) for part in speed] for speed in speeds)
                )
        return poses
