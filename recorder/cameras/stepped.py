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
from PIL import Image

from cdmisfa.core.arrays import ByteArray, FloatArray, as_array, without_table
from cdmisfa.core.blocks import Block, ForwardSource, SourceSpec, check_request, freeze
from cdmisfa.core.clock import START_NS
from cdmisfa.core.errors import LogExhaustedError, UsageError, one_line
from cdmisfa.core.gaps import stretches
from cdmisfa.core.names import ACTION, BEGINS
from recorder.images.framing import Recipe, framings, make_frame
from recorder.images.options import COLOR_RECIPE, RECIPE, Fit, Size

# Largest seed that Gymnasium's spaces accept on every system.
LARGEST_SEED: Final = 2**31 - 1

# Frames a second of an environment that does not state a rate.
DEFAULT_FPS: Final = 30.0

# The frame of each stream, None if it is missing, and the ground truth (D,) float64.
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
        self._t += n
        return stretches([frames for frames, _ in steps], self._t - n, truth)


class ArraySource(SteppedSource):
    """Source of frames that a program computes one after the other.

    A frame is an image, (height, width) or (height, width, 3), or numbers, (I,), of the types that
    `make_frame` takes. Use `cdmisfa.Recording` for complete arrays: its source can also go back.

    Args:
        streams: iterable of time steps, each one frame, or a mapping of a stream's name to its
            frame, with None for a missing frame; the first step names the streams. Or a mapping of
            a stream's name to an array or iterable of its frames.
        size: (height, width) of a frame; None: the `default_size` for the first image.
        fps: frames per second; None: the attribute `fps` of `streams`, or 50.
        start_ns: log time of frame 0 (ns).

    Raises:
        UsageError: there is no stream, or a frame differs from the first in shape or kind, or
            contains NaN or infinity; raised when the frame is taken.
    """

    def __init__(
        self,
        streams: Iterable[Any] | Mapping[str, Iterable[Any]],
        *,
        size: Size | None = None,
        fps: float | None = None,
        start_ns: int = START_NS,
    ) -> None:
        given: Iterable[Any] = streams
        length = None
        if isinstance(streams, Mapping):
            known = [len(frames) for frames in streams.values() if isinstance(frames, Sized)]
            length = min(known, default=None) if len(known) == len(streams) else None
            rows = zip(*map(without_table, streams.values()), strict=False)
            given = (dict(zip(streams, row, strict=True)) for row in rows)
        steps = (step if isinstance(step, Mapping) else {"stream": step} for step in given)
        first = next(steps, {})
        present = next((frame for frame in first.values() if frame is not None), None)
        if present is None:
            raise UsageError(
                'the first step has no frame: yield an array or {"left": array, ...} for each time '
                "step"
            )
        given_frames = [(n, present if f is None else f) for n, f in first.items()]
        frames = [np.atleast_1d(as_array(frame, str(name))) for name, frame in given_frames]
        kinds = [framing.kind for framing in framings(frames, size, "crop", color=False)]
        rate = getattr(streams, "fps", 50.0) if fps is None else fps
        spec = SourceSpec.of_kinds([*map(str, first)], kinds, (), rate, start_ns, length)
        self.gaps = length is None
        framed = _framed(spec, tuple(first), chain([first], steps))
        super().__init__(spec, chain([next(framed)], framed))  # checks the first frames at once

    def describe(self) -> Mapping[str, Any]:
        """Return the kind of the source, and the names of its streams."""
        return {"kind": "arrays", "streams": list(self._spec.streams)}


def _framed(
    spec: SourceSpec, names: Sequence[Any], steps: Iterable[Mapping[Any, Any]]
) -> Iterator[Step]:
    """Convert the frames of each stream to their shape and type, and yield them."""
    recipes = [Recipe(spec.kind(stream)[0]) for stream in range(len(names))]
    for t, step in enumerate(steps):
        if unknown := [name for name in step if name not in names]:
            raise UsageError(
                f"frame {t} is of a stream {unknown[0]}, which the first step does not name: give "
                f"None for {unknown[0]} there"
            )
        row: list[Any] = []
        for name, recipe in zip(names, recipes, strict=True):
            frame = step.get(name)
            if frame is not None:
                array = np.atleast_1d(as_array(frame, f"frame {t} of {name}"))
                try:
                    frame = make_frame(array, recipe)
                except UsageError as error:
                    about = f"{array.dtype} {array.shape}"
                    raise UsageError(f"frame {t} of {name} is {about}: {error}") from None
                if recipe.size is None and not np.isfinite(frame).all():
                    raise UsageError(
                        f"frame {t} of {name} has NaN or infinity: fill it in, or give None for a "
                        "missing frame"
                    )
            row.append(frame)
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
