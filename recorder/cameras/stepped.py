"""Sources that advance only when they are read: arrays of the caller, and Gymnasium environments.

Their streams are iterators of frames that advance together.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Sized
from itertools import chain, count, islice
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from cdmisfa.core.arrays import ByteArray, FloatArray, as_array
from cdmisfa.core.blocks import Block, ForwardSource, SourceSpec, check_request, freeze
from cdmisfa.core.clock import START_NS
from cdmisfa.core.errors import LogExhaustedError, UsageError, one_line
from cdmisfa.core.names import ACTION, BEGINS
from recorder.images.framing import framings
from recorder.images.options import COLOR_RECIPE, RECIPE, Fit, Size

# Largest seed that Gymnasium's spaces accept on every system.
LARGEST_SEED: Final = 2**31 - 1

# Frames a second of an environment that does not state a rate.
DEFAULT_FPS: Final = 30.0

# The frame of each stream, and the ground truth (D,) float64.
Step = tuple[Sequence[Any], FloatArray]

# Returns the action for an observation.
Policy = Callable[[Any], Any]


class SteppedSource(ForwardSource):
    """Base of sources whose streams are iterators on one clock; it ends with the first of them.

    The source cannot go back. Derived classes define `describe`.

    Args:
        spec: properties of the source.
        steps: frames and truth of all streams, step by step.
    """

    def __init__(self, spec: SourceSpec, steps: Iterator[Step]) -> None:
        self._spec, self._steps = spec, steps
        self._ahead: list[Step] = []

    def take_all(self, n: int) -> tuple[Block, ...]:
        """Return the next n frames of every stream; see `FrameSource`."""
        check_request(self._spec, 0, n)
        self._ahead += islice(self._steps, max(n - len(self._ahead), 0))
        if len(self._ahead) < n:
            raise LogExhaustedError(f"{len(self._ahead)} of {n} frames are left at frame {self._t}")
        steps, self._ahead = self._ahead[:n], self._ahead[n:]
        truth = freeze(np.stack([values for _, values in steps]))
        blocks = [
            Block(stream, self._t, freeze(np.stack(frames)), truth)
            for stream, frames in enumerate(zip(*(frames for frames, _ in steps), strict=True))
        ]
        self._t += n
        return tuple(blocks)


class ArraySource(SteppedSource):
    """Source of frames that a program computes one after the other.

    Use `cdmisfa.Recording` for complete arrays: its source can also go back.

    Args:
        streams: mapping of a stream's name to its frames: an array (n, height, width) of uint8 or
            (n, I) of float64, or any iterable of such frames.
        fps: frames per second.
        start_ns: log time of frame 0 (ns).

    Raises:
        UsageError: there is no stream, or a frame differs from the first in shape or type, or
            contains NaN or infinity; raised when the frame is taken.
    """

    def __init__(
        self, streams: Mapping[str, Iterable[Any]], *, fps: float = 50.0, start_ns: int = START_NS
    ) -> None:
        if not isinstance(streams, Mapping) or not streams:
            raise UsageError(
                f"streams are {type(streams).__name__}, or none: give names, as in "
                '{"left": frames}, with an array (n, height, width) of uint8 or (n, I) of float64, '
                "or an iterable of such frames"
            )
        rows = zip(*(map(as_array, frames) for frames in streams.values()), strict=False)
        first = next(rows, (np.empty(()),))
        known = [len(frames) for frames in streams.values() if isinstance(frames, Sized)]
        length = min(known) if len(known) == len(streams) else None
        shape, dtype = first[0].shape, str(first[0].dtype)
        spec = SourceSpec(tuple(streams), shape, dtype, (), fps, start_ns, length)
        steps = _checked(spec, chain([first], rows))
        super().__init__(spec, chain([next(steps)], steps))  # checks the first frames at once

    def describe(self) -> Mapping[str, Any]:
        """Return the kind of the source, and the names of its streams."""
        return {"kind": "arrays", "streams": list(self._spec.streams)}


def _checked(spec: SourceSpec, rows: Iterable[Sequence[NDArray[Any]]]) -> Iterator[Step]:
    """Check frames of all streams for shape, type and finite values, and yield them."""
    for t, row in enumerate(rows):
        for name, frame in zip(spec.streams, row, strict=True):
            alike = frame.shape == spec.frame_shape and str(frame.dtype) == spec.dtype
            if not alike or (spec.dtype, frame.ndim) not in (("uint8", 2), ("float64", 1)):
                raise UsageError(
                    f"frame {t} of {name} is {frame.dtype} {frame.shape}: give frames (height, "
                    "width) of uint8 or (I,) of float64, with one shape and type for all streams"
                )
            if frame.ndim == 1 and not np.isfinite(frame).all():
                raise UsageError(f"frame {t} of {name} has NaN or infinity: fill it in or omit it")
        yield row, np.empty(0)


class GymSource(SteppedSource):
    """Source of the rendered images of Gymnasium environments, one stream for each.

    All environments are stepped together, and a new episode follows one that ends. The same seed
    gives the same frames. The ground truth has the numbers of the observation, of the next action,
    and whether an episode begins.

    Args:
        tasks: ids of environments, or environments made with `render_mode="rgb_array"`.
        names: names of the streams; None: the ids.
        size: (height, width) of a frame; None: the aspect ratio of the images, with at most as
            many pixels as 128x48.
        fit: "crop", "pad" or "stretch" images of another aspect ratio.
        fps: frames per second; None: as the first environment states.
        seed: seed of the environments and of random actions.
        policy: function that returns the action for an observation; None: random actions.
        hold: number of frames for which an action is repeated.
        color: True to put red, green and blue side by side.

    Raises:
        UsageError: Gymnasium is missing, or an environment does not exist.
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
        self._environments = environments = [
            make_environment(task) if isinstance(task, str) else task for task in tasks
        ]
        tasks = [str(getattr(e.spec, "id", e)) for e in environments]
        names = tuple(names or tasks)
        fps = float(fps or environments[0].metadata.get("render_fps") or DEFAULT_FPS)
        steps = self._played(seed, hold, policy, color=color)
        first = next(steps)
        chosen = framings(first[0], size, fit, color=color)
        frames = (
            ([f.frame(image) for f, image in zip(chosen, images, strict=True)], values)
            for images, values in chain([first], steps)
        )
        spec = SourceSpec(names, chosen[0].shape, "uint8", self._truth(names), fps, START_NS)
        super().__init__(spec, frames)
        self._about = {
            "kind": "gym",
            "tasks": tasks,
            "seed": seed,
            "policy": "random" if policy is None else "given",
            "hold": hold,
            "size": list(spec.frame_shape),
            "fit": fit,
            "rate": fps,
            "recipe": COLOR_RECIPE if color else RECIPE,
        }

    def _truth(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return names of the columns of truth: observations, actions, and beginnings."""
        plain = [re.sub(r"[^0-9A-Za-z]", "_", name) for name in names]
        named = list(zip(plain, self._environments, strict=True))
        observed = [f"{n}_{i}" for n, e in named for i in range(_count(e.observation_space))]
        acted = [f"{ACTION}{n}_{i}" for n, e in named for i in range(_count(e.action_space))]
        return (*observed, *acted, *(f"{BEGINS}{name}" for name in plain))

    def _played(
        self, seed: int, hold: int, policy: Policy | None, *, color: bool
    ) -> Iterator[Step]:
        """Step all environments together, and render them."""
        environments = self._environments
        generators = [np.random.default_rng([seed, i]) for i in range(len(environments))]
        pairs = zip(environments, generators, strict=True)
        played = [play(environment, rng, hold, policy) for environment, rng in pairs]
        for step in zip(*played, strict=True):
            obs, actions, begins = zip(*step, strict=True)
            spaces = [(e.observation_space, o) for e, o in zip(environments, obs, strict=True)]
            spaces += [(e.action_space, a) for e, a in zip(environments, actions, strict=True)]
            numbers = [np.ravel(values) for space, values in spaces if _count(space)]
            images = [np.asarray(e.render()) for e in environments]
            if not color:
                images = [gray_image(image) for image in images]
            yield images, np.concatenate([*numbers, begins]).astype(np.float64)

    def describe(self) -> Mapping[str, Any]:
        """Return the environments, their seed, and how actions were chosen."""
        return self._about

    def close(self) -> None:
        """Close the environments."""
        for environment in self._environments:
            environment.close()


def play(
    environment: Any, rng: np.random.Generator, hold: int, policy: Policy | None = None
) -> Iterator[tuple[Any, Any, bool]]:
    """Yield the observations of an environment, step by step, without end.

    Args:
        environment: the environment, which is reset first.
        rng: generator of its seed, and of the seed of random actions.
        hold: number of steps for which an action is repeated.
        policy: returns the action for an observation; None: random actions.

    Yields:
        An observation, the action for it, and whether an episode begins with it.
    """
    observation, _ = environment.reset(seed=int(rng.integers(LARGEST_SEED)))
    environment.action_space.seed(int(rng.integers(LARGEST_SEED)))
    begins = True
    for t in count():
        if t % hold == 0:
            action = environment.action_space.sample() if policy is None else policy(observation)
        if t:
            yield observation, action, begins
            begins = False
        observation, _, ended, cut, _ = environment.step(action)
        if ended or cut:
            observation, _ = environment.reset()
            begins = True


def make_environment(task: str, **options: Any) -> Any:
    """Return a Gymnasium environment that renders.

    Args:
        task: id of the environment.
        options: arguments of the environment.

    Raises:
        UsageError: Gymnasium is missing, or the environment does not exist.
    """
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # so that pygame needs no screen
    try:
        import gymnasium

        return gymnasium.make(task, render_mode="rgb_array", **options)
    except Exception as error:  # environments raise various exceptions
        remedy = ": pip install 'cdmisfa[gym]'" if isinstance(error, ImportError) else ""
        raise UsageError(f"gym:{task} cannot be created: {one_line(error)}{remedy}") from None


def gray_image(image: Any) -> ByteArray:
    """Convert a color image, (height, width, 3), to gray, (height, width) uint8."""
    return np.asarray(Image.fromarray(image).convert("L"))


def _count(space: Any) -> int:
    """Return the number of values of a space; 0 for images, and for spaces that are not arrays."""
    shape = getattr(space, "shape", None)
    return int(np.prod(shape)) if shape is not None and len(shape) < 2 else 0
