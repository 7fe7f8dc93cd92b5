"""How the three objects of the iCub scene move, in the paper's coordinates.

Every object has a random generator of its own, and draws come in fixed chunks, so
where an object is at frame t depends on the seed and t alone.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from cdmisfa.core.arrays import FloatArray
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
    """Where all objects of a scene are at every frame, as a seed moves them."""

    def __init__(self, scene: IcubConfig, seed: int) -> None:
        self._scene, self._seed = scene, seed
        self._restart()

    def positions(self, start: int, n: int) -> FloatArray:
        """(n, objects, 2) x and y at n frames from `start` on, the paper's coordinates, metres."""
        parts = []
        while n > 0:
            chunk, first = divmod(start, CHUNK)
            parts.append(self._draw(chunk)[first : first + n])
            start, n = start + len(parts[-1]), n - len(parts[-1])
        return np.concatenate(parts)

    def _draw(self, chunk: int) -> FloatArray:
        """The positions of a chunk: draws on when it lies ahead, from the start when behind."""
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
