"""What streams of the arena show, as far as numpy makes it: patterns, light, and noise.

The makers take a generator and the number of frames.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from cdmisfa.core.arrays import ByteArray, FloatArray
from recorder.world.oscillatory import PERIOD, one_period

HEIGHT, WIDTH = 48, 64
"""Of the grey pictures of all cameras."""

FOLLOW: Final = 4
"""One frame in so many of a stream follows what a learner is shown, and is never shown to it."""

Part = Literal["following", "fitted"]
"""Of a stream: frames that follow what a learner was shown, of which it saw none, or these."""

FOLLOWING: Final = "following"
FITTED: Final = "fitted"
PARTS: Final[tuple[Part, ...]] = (FOLLOWING, FITTED)

GREY = 127.5
"""The middle of the range of pixels."""

HOLD = 10
"""Frames for which a jumping picture stands still."""

SENSOR_SD = 3.0
"""Of the noise of a sensor, in steps of a pixel."""

DRIFT = 20_000
"""Frames in which a drifting light comes and goes once."""

PIECE = 1000
"""Frames that are made at once."""

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
    def shown(self) -> NDArray[Any]:
        """The frames that a learner is shown, over and over, (n, *frame_shape)."""
        n = len(self.frames)
        return self.frames if self.loops else self.frames[: n - n // FOLLOW]

    def part(self, part: Part) -> NDArray[Any]:
        """The frames of a part; of a stream that loops, both are a round of it, with its cut."""
        if self.loops:
            return np.concatenate([self.frames, self.frames[:1]])
        return self.frames[len(self.shown) :] if part == FOLLOWING else self.shown


Maker = Callable[[Rng, int], Footage]


def stateless(frames: NDArray[Any]) -> Footage:
    """Frames, (n, *frame_shape), without a state of the world."""
    return Footage(frames, np.zeros((len(frames), 0)))


def pixels(values: NDArray[Any]) -> ByteArray:
    """Values, of any shape, as pixels: rounded, and cut off at black and white."""
    return np.asarray(np.rint(values).clip(0, 255), np.uint8)


def wandering(rng: Rng, n: int, memory: float) -> FloatArray:
    """(n,) a smooth random course about 0, of standard deviation 1.

    Noise that two leaky means have smoothed, each of so many frames.
    """
    rate = 1 / memory
    first = second = 0.0
    course = np.empty(n + round(10 * memory))
    for t, drawn in enumerate(rng.standard_normal(len(course))):
        first += rate * (drawn - first)
        second += rate * (first - second)
        course[t] = second
    return np.asarray(course[-n:] * 2 / np.sqrt(rate))


# What can be learned.


def light(rng: Rng, n: int) -> Footage:
    """A picture whose brightness drifts, seen through a sensor's noise."""
    shown = soft_picture(rng)
    brightness = 30 * np.sin(np.cumsum(rng.normal(0, 0.5, n)) / 10)
    drifting = brightness[:, None, None]
    frames = in_pieces(
        n, lambda at, m: shown + drifting[at : at + m] + SENSOR_SD * gaussian(rng, m)
    ).frames
    return Footage(frames, brightness[:, None], ("brightness",))


def drifting(rng: Rng, n: int) -> Footage:
    """A picture lit from one side, then from the other, in `DRIFT` frames; a sensor's noise."""
    shown = soft_picture(rng)
    side = np.linspace(-30, 30, WIDTH)
    drift = np.sin(2 * np.pi * (np.arange(n) / DRIFT + rng.random()))
    frames = in_pieces(
        n,
        lambda at, m: shown + drift[at : at + m, None, None] * side + SENSOR_SD * gaussian(rng, m),
    ).frames
    return Footage(frames, drift[:, None], ("drift",))


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


# What cannot: noise, and what stands still.


def full_noise(rng: Rng, n: int) -> Footage:
    """Every pixel of every frame drawn from all 256 values."""
    return stateless(rng.integers(0, 256, (n, HEIGHT, WIDTH), dtype=np.uint8))


def gaussian_noise(sd: float) -> Maker:
    """Gaussian noise about grey, its standard deviation as a share of the full range."""
    return lambda rng, n: in_pieces(n, lambda at, m: GREY + 255 * sd * gaussian(rng, m))


def uniform_noise(sd: float) -> Maker:
    """Uniform noise about grey, its standard deviation as a share of the full range."""
    half = 255 * sd * np.sqrt(3.0)
    shape = HEIGHT, WIDTH
    return lambda rng, n: in_pieces(
        n, lambda at, m: GREY + half * (2 * rng.random((m, *shape), np.float32) - 1)
    )


def vector_noise(rng: Rng, n: int) -> Footage:
    """Gaussian noise of standard deviation 1 in two values, beside the oscillatory streams."""
    return stateless(rng.standard_normal((n, 2)))


def jumping(rng: Rng, n: int) -> Footage:
    """Another picture every `HOLD` frames."""
    shown = np.stack([soft_picture(rng) for _ in range(-(-n // HOLD))])
    return stateless(np.repeat(pixels(shown), HOLD, axis=0)[:n])


def constant(rng: Rng, n: int) -> Footage:
    """One grey."""
    return stateless(np.full((n, HEIGHT, WIDTH), 90, np.uint8))


def still(rng: Rng, n: int) -> Footage:
    """A picture that stands still, seen through a sensor's noise."""
    shown = soft_picture(rng)
    return in_pieces(n, lambda at, m: shown + SENSOR_SD * gaussian(rng, m))


def pink(rng: Rng, n: int) -> Footage:
    """Clouds, others with each frame: noise whose amplitude falls with spatial frequency."""
    down, right = np.fft.fftfreq(HEIGHT)[:, None], np.fft.rfftfreq(WIDTH)
    falling = 1 / np.hypot(down, right).clip(1 / WIDTH)
    falling[0, 0] = 0
    scale = 40 / np.sqrt((falling**2).mean())

    def seen(at: int, m: int) -> NDArray[np.floating]:
        return np.asarray(GREY + scale * np.fft.irfft2(np.fft.rfft2(gaussian(rng, m)) * falling))

    return in_pieces(n, seen)


def salt(rng: Rng, n: int) -> Footage:
    """A still picture of whose pixels a tenth are black or white, others with each frame."""
    shown = soft_picture(rng)

    def seen(at: int, m: int) -> NDArray[np.floating]:
        drawn = rng.random((m, HEIGHT, WIDTH), np.float32)
        return np.where(drawn < 0.05, 0.0, np.where(drawn > 0.95, 255.0, shown))

    return in_pieces(n, seen)


def speckle(rng: Rng, n: int) -> Footage:
    """A still picture, each pixel times Gaussian noise about 1, as of a laser or a radar."""
    shown = soft_picture(rng)
    return in_pieces(n, lambda at, m: shown * (1 + 0.3 * gaussian(rng, m)))


def shot(rng: Rng, n: int) -> Footage:
    """A still picture in little light: ten photons for a white pixel."""
    shown = soft_picture(rng) / 25.5
    return in_pieces(n, lambda at, m: 25.5 * rng.poisson(shown, (m, HEIGHT, WIDTH)))


def bands(rng: Rng, n: int) -> Footage:
    """A still picture with the rolling bands of a lamp that is not in step with the shutter."""
    shown = soft_picture(rng)
    phase = np.cumsum(rng.normal(2.4, 0.4, n))
    rows = 2 * np.pi * np.arange(HEIGHT) / 24

    def seen(at: int, m: int) -> NDArray[np.floating]:
        rolling = 20 * np.cos(rows - phase[at : at + m, None])[:, :, None]
        return np.asarray(shown + rolling + SENSOR_SD * gaussian(rng, m))

    return in_pieces(n, seen)


def soft_picture(rng: Rng) -> FloatArray:
    """A picture of soft patches, (HEIGHT, WIDTH)."""
    patches = Image.fromarray(rng.standard_normal((6, 8)).astype(np.float32))
    smooth = patches.resize((WIDTH, HEIGHT), Image.Resampling.BICUBIC)
    return np.asarray(128 + 40 * np.asarray(smooth, np.float64)).clip(0, 255)


def gaussian(rng: Rng, n: int) -> NDArray[np.float32]:
    return rng.standard_normal((n, HEIGHT, WIDTH), np.float32)


def in_pieces(n: int, make: Callable[[int, int], NDArray[np.floating]]) -> Footage:
    """So many frames, made some at a time: from which frame on, and how many."""
    starts = range(0, n, PIECE)
    return stateless(np.concatenate([pixels(make(at, min(PIECE, n - at))) for at in starts]))
