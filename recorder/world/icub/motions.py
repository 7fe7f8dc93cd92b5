"""How the three objects of the iCub scene move, in the paper's coordinates.

Every object has a random generator of its own, and draws come in fixed chunks, so
where an object is at frame t depends on the seed and t alone.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.blocks import check_frame
from recorder.world.icub.config import BoxConfig, CylinderConfig, IcubConfig, Range, SphereConfig

CHUNK = 4096
"""Frames drawn at a time."""

_WORLD = 0x1C0B
"""Spawn key of the world: the learner may spawn its own generators from the same seed."""


Motion = Iterator[FloatArray]
"""Positions of one object, (CHUNK, 2), chunk after chunk."""


def toggling_motion(config: BoxConfig, generator: np.random.Generator) -> Motion:
    """X uniform and independent; y one of two places, changing every so many frames."""
    for t in itertools.count(0, CHUNK):
        x = _uniform(generator.random(CHUNK), config.x)
        phase = (t + np.arange(CHUNK)) // config.toggle_every % 2
        yield np.stack([x, np.asarray(config.y)[phase]], axis=1)


def uniform_motion(config: CylinderConfig, generator: np.random.Generator) -> Motion:
    """X and y uniform and independent of the frame before."""
    while True:
        units = generator.random((CHUNK, 2))
        yield np.stack([_uniform(units[:, 0], config.x), _uniform(units[:, 1], config.y)], axis=1)


def walking_motion(config: SphereConfig, generator: np.random.Generator) -> Motion:
    """A Gaussian random walk, reflected at the borders; starts anywhere within them."""
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
    """A free walk, (n,), as one that turns round at the limits."""
    low, high = limits
    width = high - low
    if width == 0:
        return np.full_like(values, low)
    return np.clip(low + width - np.abs((values - low) % (2 * width) - width), low, high)


class Motions:
    """Where all objects of a scene are, frame after frame, as a seed moves them."""

    def __init__(self, scene: IcubConfig, seed: int) -> None:
        self._scene = scene
        self._seed = seed
        self._restart()
        self.seek(0)

    @property
    def t(self) -> int:
        """Frame of the next positions."""
        return self._t

    def seek(self, t: int) -> None:
        """Go to frame t: drawing on when it lies ahead, from the start when behind."""
        check_frame(t)
        chunk = t // CHUNK
        if chunk < self._chunk:
            self._restart()
        while self._chunk < chunk:
            self._positions = np.stack([next(motion) for motion in self._motions], axis=1)
            self._chunk += 1
        self._t = t

    def take(self, n: int) -> FloatArray:
        """(n, objects, 2) x and y in the next n frames, the paper's coordinates, metres."""
        parts = []
        while n > 0:
            self.seek(self._t)
            start = self._t % CHUNK
            part = self._positions[start : start + n]
            parts.append(part)
            self._t += len(part)
            n -= len(part)
        return np.concatenate(parts)

    def _restart(self) -> None:
        box, cylinder, sphere = (
            np.random.Generator(
                np.random.PCG64(np.random.SeedSequence(self._seed, spawn_key=(_WORLD, i)))
            )
            for i in range(3)
        )
        self._motions = (
            toggling_motion(self._scene.object1, box),
            uniform_motion(self._scene.object2, cylinder),
            walking_motion(self._scene.object3, sphere),
        )
        self._chunk = -1


def _uniform(unit: FloatArray, limits: Range) -> FloatArray:
    return limits[0] + (limits[1] - limits[0]) * unit
