"""Gymnasium's environments as streams: what they render, and their observations as the truth."""

from __future__ import annotations

import importlib
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain
from typing import Any, Final

import numpy as np
from PIL import Image

from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.clock import START_NS
from cdmisfa.core.errors import UsageError, one_line
from recorder.cameras.stepped import Step, SteppedSource
from recorder.images.framing import Fit, Size, framings
from recorder.images.pixels import RECIPE, Bytes
from recorder.images.videos import COLOR_RECIPE

LARGEST_SEED: Final = 2**31 - 1

FPS: Final = 30.0
"""Frames a second of an environment that states no rate."""

Policy = Callable[[Any], Any]
"""Gives the action for an observation."""


class GymSource(SteppedSource):
    """Environments that render, one a stream, stepped together; the same seed shows the same.

    An episode that ends is followed by another.

    Args:
        tasks: the environments' ids, or environments made with `render_mode="rgb_array"`.
        names: of the streams; by default the ids.
        size: (height, width) of a frame; by default `default_size` of the first's pictures.
        fit: how pictures of another aspect ratio become frames: see `fitted`.
        fps: frames a second; by default as the first environment states.
        seed: of the environments and of random actions.
        policy: gives the action for an observation; by default actions are random.
        hold: frames for which an action is kept.
        color: show red, green and blue beside one another.

    Raises:
        UsageError: Gymnasium is missing, or there is no such environment.
    """

    def __init__(
        self,
        tasks: Sequence[Any],
        *,
        names: Sequence[str] | None = None,
        size: Size | None = None,
        fit: Fit = "crop",
        fps: float | None = None,
        seed: int = 0,
        policy: Policy | None = None,
        hold: int = 1,
        color: bool = False,
    ) -> None:
        self._environments = [make(task) if isinstance(task, str) else task for task in tasks]
        self._tasks = [str(getattr(e.spec, "id", e)) for e in self._environments]
        stated = self._environments[0].metadata.get("render_fps")
        numbered = [_numbers(e.observation_space) for e in self._environments]
        self._fit, self._seed, self._hold, self._random = fit, seed, hold, policy is None
        self._color = color
        names = tuple(names or self._tasks)
        truth = tuple(
            f"{re.sub(r'[^0-9A-Za-z]', '_', name)}_{i}"
            for name, n in zip(names, numbered, strict=True)
            for i in range(n)
        )
        fps = float(fps or stated or FPS)
        played = [
            play(environment, np.random.default_rng([seed, number]), hold, policy)
            for number, environment in enumerate(self._environments)
        ]

        shown = np.asarray if color else picture

        def step(seen: Sequence[Any]) -> Step:
            known = [np.ravel(o) for o, n in zip(seen, numbered, strict=True) if n]
            pictures = [shown(environment.render()) for environment in self._environments]
            return pictures, np.concatenate([*known, np.empty(0)]).astype(np.float64)

        steps = map(step, zip(*played, strict=True))
        first = next(steps)
        made = framings(first[0], size, fit, color=color)

        def frames() -> Iterator[Step]:
            for pictures, values in chain([first], steps):
                framed = zip(made, pictures, strict=True)
                yield [framing.frame(picture) for framing, picture in framed], values

        super().__init__(SourceSpec(names, made[0].shape, "uint8", truth, fps, START_NS), frames())

    def describe(self) -> Mapping[str, Any]:
        """The environments, their seed, and how they were played."""
        policy = "random" if self._random else "given"
        return {
            "kind": "gym",
            "tasks": self._tasks,
            "seed": self._seed,
            "policy": policy,
            "hold": self._hold,
            "size": list(self._spec.frame_shape),
            "fit": self._fit,
            "rate": self._spec.fps,
            "recipe": COLOR_RECIPE if self._color else RECIPE,
        }

    def close(self) -> None:
        """Close the environments."""
        for environment in self._environments:
            environment.close()


def play(
    environment: Any, rng: np.random.Generator, hold: int, policy: Policy | None = None
) -> Iterator[Any]:
    """What an environment's observations are, step by step, for ever.

    Args:
        environment: reset here.
        rng: gives its seed, and that of random actions.
        hold: steps for which an action is kept.
        policy: gives the action for an observation; by default actions are random.
    """
    seen, _ = environment.reset(seed=int(rng.integers(LARGEST_SEED)))
    environment.action_space.seed(int(rng.integers(LARGEST_SEED)))
    t = 0
    while True:
        if t % hold == 0:
            action = environment.action_space.sample() if policy is None else policy(seen)
        seen, _, ended, cut, _ = environment.step(action)
        if ended or cut:
            seen, _ = environment.reset()
        yield seen
        t += 1


def make(task: str, **options: Any) -> Any:
    """Make an environment that renders, of Gymnasium's own or of Atari's.

    Args:
        task: its id.
        options: its own.

    Raises:
        UsageError: Gymnasium is missing, or there is no such environment.
    """
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # pygame needs no screen
    gymnasium = package("gymnasium", "gym")
    if task.startswith("ALE/"):
        ale = package("ale_py", "arena")
        ale.ALEInterface.setLoggerMode(ale.LoggerMode.Error)
        gymnasium.register_envs(ale)
    try:
        return gymnasium.make(task, render_mode="rgb_array", **options)
    except Exception as error:  # whatever an environment raises
        raise UsageError(f"gym:{task} cannot be made: {one_line(error)}") from None


def package(name: str, extra: str) -> Any:
    """Import a package.

    Raises:
        UsageError: it is missing.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        missing = f"it needs {name}, which is missing: pip install 'cdmisfa[{extra}]'"
        raise UsageError(missing) from error


def picture(seen: Any) -> Bytes:
    """A colour picture in gray, (height, width) uint8."""
    return np.asarray(Image.fromarray(seen).convert("L"))


def _numbers(space: Any) -> int:
    """How many numbers an observation is; 0 where it is a picture, or no array."""
    shape = getattr(space, "shape", None)
    return int(np.prod(shape)) if shape is not None and len(shape) < 2 else 0
