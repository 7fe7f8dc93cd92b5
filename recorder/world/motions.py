"""How the three objects of the iCub scene move, in the paper's coordinates.

Every object has a random generator of its own, and draws come in fixed chunks, so
where an object is at frame t depends on the seed and t alone.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from recorder.world.icub_config import BoxConfig, CylinderConfig, IcubConfig, Range, SphereConfig

CHUNK = 4096
"""Frames drawn at a time."""

_WORLD = 0x1C0B
"""Spawn key of the world: the learner may spawn its own generators from the same seed."""

Float = NDArray[np.float64]


class Motion(Protocol):
    """Positions of one object, chunk after chunk."""

    def draw(self) -> Float:
        """The next CHUNK positions, (CHUNK, 2)."""


class Toggling:
    """x uniform and independent; y one of two places, changing every so many frames."""

    def __init__(self, config: BoxConfig, generator: np.random.Generator) -> None:
        self._config = config
        self._generator = generator
        self._t = 0

    def draw(self) -> Float:
        """See `Motion.draw`."""
        x = _uniform(self._generator.random(CHUNK), self._config.x)
        phase = (self._t + np.arange(CHUNK)) // self._config.toggle_every % 2
        self._t += CHUNK
        return np.stack([x, np.asarray(self._config.y)[phase]], axis=1)


class Uniform:
    """x and y uniform and independent of the frame before."""

    def __init__(self, config: CylinderConfig, generator: np.random.Generator) -> None:
        self._config = config
        self._generator = generator

    def draw(self) -> Float:
        """See `Motion.draw`."""
        units = self._generator.random((CHUNK, 2))
        return np.stack(
            [_uniform(units[:, 0], self._config.x), _uniform(units[:, 1], self._config.y)], axis=1
        )


class Walk:
    """A Gaussian random walk, reflected at the borders; starts anywhere within them."""

    def __init__(self, config: SphereConfig, generator: np.random.Generator) -> None:
        self._limits = (config.x, config.y)
        self._steps = np.array([config.step_x, config.step_y])
        self._generator = generator
        self._last = np.stack(
            [_uniform(generator.random(1), limits) for limits in self._limits], axis=1
        )
        self._started = False

    def draw(self) -> Float:
        """See `Motion.draw`."""
        steps = self._generator.standard_normal((CHUNK, 2)) * self._steps
        if not self._started:
            steps[0] = 0.0
            self._started = True
        steps[0] += self._last[0]
        free = np.cumsum(steps, axis=0)
        path = np.stack(
            [reflect(free[:, i], limits) for i, limits in enumerate(self._limits)], axis=1
        )
        self._last = path[-1:]
        return path


def reflect(values: Float, limits: Range) -> Float:
    """A free walk as one that turns round at the limits."""
    low, high = limits
    width = high - low
    if width == 0:
        return np.full_like(values, low)
    return np.clip(low + width - np.abs((values - low) % (2 * width) - width), low, high)


class Motions:
    """Where all objects are, frame after frame.

    Args:
        scene: the objects.
        seed: of their motions.
    """

    def __init__(self, scene: IcubConfig, seed: int) -> None:
        self._makers: list[Callable[[np.random.Generator], Motion]] = [
            partial(Toggling, scene.object1),
            partial(Uniform, scene.object2),
            partial(Walk, scene.object3),
        ]
        self._seed = seed
        self._restart()
        self.seek(0)

    @property
    def t(self) -> int:
        """Frame of the next positions."""
        return self._t

    def seek(self, t: int) -> None:
        """Go to frame t: drawing on when it lies ahead, from the start when behind.

        Raises:
            ValueError: t is negative.
        """
        if t < 0:
            raise ValueError(f"frame {t} does not exist: the first is 0")
        chunk = t // CHUNK
        if chunk < self._chunk:
            self._restart()
        while self._chunk < chunk:
            self._next_chunk()
        self._t = t

    def take(self, n: int) -> Float:
        """The positions of the next n frames.

        Returns:
            (n, objects, 2): x and y of every object in the paper's coordinates, metres.
        """
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
        self._motions = [
            make(np.random.Generator(np.random.PCG64(self._generator_seed(i))))
            for i, make in enumerate(self._makers)
        ]
        self._chunk = -1

    def _next_chunk(self) -> None:
        self._positions = np.stack([motion.draw() for motion in self._motions], axis=1)
        self._chunk += 1

    def _generator_seed(self, index: int) -> np.random.SeedSequence:
        return np.random.SeedSequence(self._seed, spawn_key=(_WORLD, index))


def _uniform(unit: Float, limits: Range) -> Float:
    return limits[0] + (limits[1] - limits[0]) * unit
