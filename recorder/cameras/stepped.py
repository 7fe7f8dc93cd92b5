"""Streams that wait for their reader: arrays of the caller's, and Gymnasium's environments.

They are iterators of frames, one step at a time together.
"""

from __future__ import annotations

import importlib
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
from cdmisfa.core.shown import MOST_STREAMS, beside
from recorder.images.framing import framings
from recorder.images.options import COLOR_RECIPE, RECIPE, Fit, Size

LARGEST_SEED: Final = 2**31 - 1

FPS: Final = 30.0
"""Frames a second of an environment that states no rate."""

Step = tuple[Sequence[Any], FloatArray]
"""The frame of each stream, and what the world knows at it, (D,) float64."""

Policy = Callable[[Any], Any]
"""Gives the action for an observation."""


class SteppedSource(ForwardSource):
    """Streams that are iterators, on one clock; it ends with the first of them.

    It cannot go back. A class that derives from it adds `describe`.

    Args:
        spec: what the source delivers.
        steps: what is shown, frame by frame.
    """

    def __init__(self, spec: SourceSpec, steps: Iterator[Step]) -> None:
        self._spec, self._steps = spec, steps
        self._ahead: list[Step] = []

    def take(self, stream: int, n: int) -> Block:
        """See `FrameSource`."""
        check_request(self._spec, stream, n)
        return self.take_all(n)[stream]

    def take_all(self, n: int) -> tuple[Block, ...]:
        """See `FrameSource`."""
        check_request(self._spec, 0, n)
        self._ahead += islice(self._steps, max(n - len(self._ahead), 0))
        if len(self._ahead) < n:
            raise LogExhaustedError(
                f"{len(self._ahead)} frames are left at frame {self._t}, {n} are needed"
            )
        shown, self._ahead = self._ahead[:n], self._ahead[n:]
        truth = freeze(np.stack([values for _, values in shown]))
        blocks = [
            Block(stream, self._t, freeze(np.stack([frames[stream] for frames, _ in shown])), truth)
            for stream in range(len(self._spec.streams))
        ]
        self._t += n
        return tuple(blocks)

    def _picture(self) -> NDArray[np.uint8] | None:
        """The next image of each stream, which is not gone then."""
        self._ahead += islice(self._steps, 0 if self._ahead else 1)
        if not (self._ahead and self._spec.images):
            return None
        return beside(list(self._ahead[0][0][:MOST_STREAMS]))


_ARRAYS = (
    'name each, as {"left": frames}, with an array (n, height, width) of uint8 or (n, I) of '
    "float64, or an iterable of such frames"
)


class ArraySource(SteppedSource):
    """Frames that the caller makes, one after the other, as streams.

    Of arrays that are all there `cdmisfa.Recording` gives a source that can go back, too.

    Args:
        streams: for each stream, by its name, an array (n, height, width) of uint8 or (n, I) of
            float64, or any iterable of such frames.
        fps: frames a second.
        start_ns: log time of frame 0, in nanoseconds.

    Raises:
        UsageError: a stream is empty, or frames are of other sizes or types than pixels or values,
            or hold what is no finite number; as soon as such a one comes.
    """

    def __init__(
        self,
        streams: Mapping[str, Iterable[Any]],
        *,
        fps: float = 50.0,
        start_ns: int = START_NS,
    ) -> None:
        if not isinstance(streams, Mapping):
            raise UsageError(f"streams of {type(streams).__name__} given: {_ARRAYS}")
        if not streams:
            raise UsageError("no stream given: name one at least")
        for name, frames in streams.items():
            if not isinstance(name, str) or not isinstance(frames, Iterable):
                raise UsageError(f"{type(frames).__name__} given as stream {name!r}: {_ARRAYS}")
        shown = {name: iter(frames) for name, frames in streams.items()}
        firsts = {name: as_array(next(frames, ())) for name, frames in shown.items()}
        for name, first in firsts.items():
            if (str(first.dtype), first.ndim) not in (("uint8", 2), ("float64", 1)):
                raise UsageError(
                    f"{name} shows {first.dtype} of shape {first.shape}: give frames (height, "
                    "width) of uint8 or (I,) of float64"
                )
        first = next(iter(firsts.values()))
        known = [len(frames) for frames in streams.values() if isinstance(frames, Sized)]
        length = min(known) if len(known) == len(streams) else None
        dtype = str(first.dtype)
        spec = SourceSpec(tuple(streams), first.shape, dtype, (), fps, start_ns, length)
        alike = [_checked(n, chain([firsts[n]], frames), spec) for n, frames in shown.items()]
        super().__init__(spec, ((frames, np.empty(0)) for frames in zip(*alike, strict=False)))

    def describe(self) -> Mapping[str, Any]:
        """The kind of source, and its streams."""
        return {"kind": "arrays", "streams": list(self._spec.streams)}


def _checked(name: str, frames: Iterable[Any], spec: SourceSpec) -> Iterator[Any]:
    """The frames of a stream, all of one size and type, and of finite numbers."""
    for t, frame in enumerate(map(as_array, frames)):
        if frame.shape != spec.frame_shape or frame.dtype != spec.dtype:
            raise UsageError(
                f"{name} shows {frame.dtype} of shape {frame.shape}, not {spec.dtype} of "
                f"{spec.frame_shape} as the first stream does: give frames of one size and type"
            )
        if frame.dtype.kind == "f" and not np.isfinite(frame).all():
            raise UsageError(
                f"{name}: frame {t}, counted from 0, holds what is no finite number (NaN or "
                "infinity): leave it out or fill it in"
            )
        yield frame


class GymSource(SteppedSource):
    """Environments that render, one a stream, stepped together; the same seed shows the same.

    An episode that ends is followed by another. Their truth is the numbers of each one's
    observation, of the action that it is followed by, and whether an episode begins with it.

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
        if not tasks or isinstance(tasks, str):
            raise UsageError(f'tasks {tasks!r} given: give a list, as ["CartPole-v1"]')
        self._environments = environments = [
            make_environment(task) if isinstance(task, str) else task for task in tasks
        ]
        tasks = [str(getattr(e.spec, "id", e)) for e in environments]
        names = tuple(names or tasks)
        plain = [re.sub(r"[^0-9A-Za-z]", "_", name) for name in names]
        observed = [_numbers(e.observation_space) for e in environments]
        acted = [_numbers(e.action_space) for e in environments]
        truth = (
            *(f"{name}_{i}" for name, n in zip(plain, observed, strict=True) for i in range(n)),
            *(
                f"{ACTION}{name}_{i}"
                for name, n in zip(plain, acted, strict=True)
                for i in range(n)
            ),
            *(f"{BEGINS}{name}" for name in plain),
        )
        fps = float(fps or environments[0].metadata.get("render_fps") or FPS)
        shown = np.asarray if color else gray_picture
        generators = [np.random.default_rng([seed, i]) for i in range(len(environments))]
        played = [
            play(e, rng, hold, policy) for e, rng in zip(environments, generators, strict=True)
        ]

        def step(played: Sequence[tuple[Any, Any, bool]]) -> Step:
            seen, actions, begins = zip(*played, strict=True)
            known = [np.ravel(o) for o, n in zip(seen, observed, strict=True) if n]
            known += [np.ravel(a) for a, n in zip(actions, acted, strict=True) if n]
            pictures = [shown(e.render()) for e in environments]
            return pictures, np.concatenate([*known, begins]).astype(np.float64)

        steps = map(step, zip(*played, strict=True))
        first = next(steps)
        made = framings(first[0], size, fit, color=color)
        frames = (
            ([f.frame(picture) for f, picture in zip(made, pictures, strict=True)], values)
            for pictures, values in chain([first], steps)
        )
        spec = SourceSpec(names, made[0].shape, "uint8", truth, fps, START_NS)
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

    def describe(self) -> Mapping[str, Any]:
        """The environments, their seed, and how they were played."""
        return self._about

    def close(self) -> None:
        """Close the environments."""
        for environment in self._environments:
            environment.close()


def play(
    environment: Any, rng: np.random.Generator, hold: int, policy: Policy | None = None
) -> Iterator[tuple[Any, Any, bool]]:
    """An environment's observations, step by step, for ever.

    Args:
        environment: reset here.
        rng: gives its seed, and that of random actions.
        hold: steps for which an action is kept.
        policy: gives the action for an observation; by default actions are random.

    Yields:
        An observation, the action for it, and whether an episode begins with it.
    """
    seen, _ = environment.reset(seed=int(rng.integers(LARGEST_SEED)))
    environment.action_space.seed(int(rng.integers(LARGEST_SEED)))
    begins = True
    for t in count():
        if t % hold == 0:
            action = environment.action_space.sample() if policy is None else policy(seen)
        if t:
            yield seen, action, begins
            begins = False
        seen, _, ended, cut, _ = environment.step(action)
        if ended or cut:
            seen, _ = environment.reset()
            begins = True


def make_environment(task: str, **options: Any) -> Any:
    """Make an environment that renders, of Gymnasium's own or of Atari's.

    Args:
        task: its id.
        options: its own.

    Raises:
        UsageError: Gymnasium is missing, or there is no such environment.
    """
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # pygame needs no screen
    gymnasium = _package("gymnasium", "gym")
    if task.startswith("ALE/"):
        ale = _package("ale_py", "bench")
        ale.ALEInterface.setLoggerMode(ale.LoggerMode.Error)
        gymnasium.register_envs(ale)
    try:
        return gymnasium.make(task, render_mode="rgb_array", **options)
    except Exception as error:  # whatever an environment raises
        raise UsageError(f"gym:{task} cannot be made: {one_line(error)}") from None


def gray_picture(seen: Any) -> ByteArray:
    """A colour picture, (height, width, 3), in gray, (height, width) uint8."""
    return np.asarray(Image.fromarray(seen).convert("L"))


def _package(name: str, extra: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        missing = f"it needs {name}, which is missing: pip install 'cdmisfa[{extra}]'"
        raise UsageError(missing) from error


def _numbers(space: Any) -> int:
    """How many numbers an observation is; 0 where it is a picture, or no array."""
    shape = getattr(space, "shape", None)
    return int(np.prod(shape)) if shape is not None and len(shape) < 2 else 0
