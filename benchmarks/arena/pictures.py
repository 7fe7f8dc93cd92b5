"""Streams that numpy makes: patterns, light and noise; and cameras that alter any stream.

Makers take a generator and the number of frames; cameras take a generator and footage.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from cdmisfa.core.arrays import ByteArray, FloatArray
from recorder.world.oscillatory import PERIOD, one_period

HEIGHT, WIDTH = 48, 64
"""Size of the grey images."""

GREY = 127.5
SENSOR_SD = 3.0
"""Standard deviation of a sensor's noise, in pixel steps."""

DRIFT = 20_000
"""Frames of one cycle of the drifting light."""

PIECE = 1000
"""Frames that are made at once, to bound memory; another number draws other noise."""

Rng = np.random.Generator


@dataclass(frozen=True, slots=True)
class Footage:
    """The frames of a stream, with the state of the world behind each where it has one.

    Attributes:
        frames: (n, *frame_shape), uint8 pixels or float64 values.
        state: (n, C) float64; C may be 0.
    """

    frames: NDArray[Any]
    state: FloatArray

    @property
    def training(self) -> NDArray[Any]:
        """The frames that a learner sees, again and again: the first three quarters."""
        return self.frames[: len(self.frames) * 3 // 4]

    @property
    def following(self) -> NDArray[Any]:
        """The frames that modules are judged on: the last quarter."""
        return self.frames[len(self.training) :]


def stateless(frames: NDArray[Any]) -> Footage:
    """Return frames, (n, *frame_shape), without a state of the world."""
    return Footage(frames, np.zeros((len(frames), 0)))


def pixels(values: NDArray[Any]) -> ByteArray:
    """Return values, of any shape, as pixels: rounded and clipped."""
    return np.asarray(np.rint(values).clip(0, 255), np.uint8)


def in_pieces(n: int, make: Callable[[int, int], NDArray[Any]]) -> ByteArray:
    """Return n frames; `make` gets the first frame of a piece and its length."""
    starts = range(0, n, PIECE)
    return np.concatenate([pixels(make(at, min(PIECE, n - at))) for at in starts])


def gaussian(rng: Rng, n: int) -> NDArray[np.float32]:
    return rng.standard_normal((n, HEIGHT, WIDTH), np.float32)


def soft_image(rng: Rng) -> FloatArray:
    """Return an image of soft patches, (HEIGHT, WIDTH)."""
    patches = Image.fromarray(rng.standard_normal((6, 8)).astype(np.float32))
    smooth = patches.resize((WIDTH, HEIGHT), Image.Resampling.BICUBIC)
    return np.asarray(128 + 40 * np.asarray(smooth, np.float64)).clip(0, 255)


def wandering(rng: Rng, n: int, memory: float) -> FloatArray:
    """Return (n,) a smooth random course of mean 0 and standard deviation 1.

    It is white noise after two leaky means of so many frames.
    """
    rate = 1 / memory
    first = second = 0.0
    course = np.empty(n + round(10 * memory))
    for t, drawn in enumerate(rng.standard_normal(len(course))):
        first += rate * (drawn - first)
        second += rate * (first - second)
        course[t] = second
    return np.asarray(course[-n:] * 2 / np.sqrt(rate))


# Learnable streams.


def light(rng: Rng, n: int) -> Footage:
    """An image whose brightness drifts, with a sensor's noise."""
    image = soft_image(rng)
    brightness = 30 * np.sin(np.cumsum(rng.normal(0, 0.5, n)) / 10)
    return _lit(rng, image, brightness, np.ones(WIDTH))


def drifting(rng: Rng, n: int) -> Footage:
    """An image lit from one side, then from the other, in `DRIFT` frames."""
    image = soft_image(rng)
    drift = np.sin(2 * np.pi * (np.arange(n) / DRIFT + rng.random()))
    return _lit(rng, image, drift, np.linspace(-30, 30, WIDTH))


def _lit(rng: Rng, image: FloatArray, course: FloatArray, side: FloatArray) -> Footage:
    def seen(at: int, m: int) -> NDArray[Any]:
        return image + course[at : at + m, None, None] * side + SENSOR_SD * gaussian(rng, m)

    return Footage(in_pieces(len(course), seen), course[:, None])


def waves(rng: Rng, n: int) -> Footage:
    """A grating that drifts to and fro, under another whose phase jumps with each frame."""
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
    return Footage(frames, np.stack([np.cos(phase), np.sin(phase)], axis=1))


def oscillatory(rng: Rng, n: int, name: str, frequency: int, shift: float) -> Footage:
    """One of the paper's oscillatory streams; its slow feature is the state."""
    index = np.arange(n) % PERIOD
    slow = np.sin(2 * np.pi * frequency * index / PERIOD + shift * np.pi)
    return Footage(one_period(name)[index], slow[:, None])


# Streams without a slow feature.


def full_noise(rng: Rng, n: int) -> Footage:
    return stateless(rng.integers(0, 256, (n, HEIGHT, WIDTH), dtype=np.uint8))


def gaussian_noise(rng: Rng, n: int, sd: float) -> Footage:
    """Gaussian noise; `sd` is a share of the full range."""
    return stateless(in_pieces(n, lambda at, m: GREY + 255 * sd * gaussian(rng, m)))


def uniform_noise(rng: Rng, n: int, sd: float) -> Footage:
    """Uniform noise; `sd` is a share of the full range."""

    def seen(at: int, m: int) -> NDArray[Any]:
        return GREY + 255 * sd * np.sqrt(3.0) * (2 * rng.random((m, HEIGHT, WIDTH), np.float32) - 1)

    return stateless(in_pieces(n, seen))


def vector_noise(rng: Rng, n: int) -> Footage:
    """Gaussian noise in two values, beside the oscillatory streams."""
    return stateless(rng.standard_normal((n, 2)))


def jumping(rng: Rng, n: int) -> Footage:
    """Another image every 10 frames."""
    images = np.stack([soft_image(rng) for _ in range(-(-n // 10))])
    return stateless(np.repeat(pixels(images), 10, axis=0)[:n])


def constant(rng: Rng, n: int) -> Footage:
    return stateless(np.full((n, HEIGHT, WIDTH), 90, np.uint8))


def pink(rng: Rng, n: int) -> Footage:
    """Noise whose amplitude falls with spatial frequency."""
    falling = 1 / np.hypot(np.fft.fftfreq(HEIGHT)[:, None], np.fft.rfftfreq(WIDTH)).clip(1 / WIDTH)
    falling[0, 0] = 0
    scale = 40 / np.sqrt((falling**2).mean())

    def seen(at: int, m: int) -> NDArray[Any]:
        return GREY + scale * np.fft.irfft2(np.fft.rfft2(gaussian(rng, m)) * falling)

    return stateless(in_pieces(n, seen))


def noisy(rng: Rng, n: int, noise: str) -> Footage:
    """A still image under one of `NOISES`."""
    image = soft_image(rng)
    return stateless(in_pieces(n, lambda at, m: NOISES[noise](rng, image, m)))


def _salted(rng: Rng, image: FloatArray, m: int) -> NDArray[Any]:
    drawn = rng.random((m, HEIGHT, WIDTH), np.float32)
    return np.where(drawn < 0.05, 0.0, np.where(drawn > 0.95, 255.0, image))


NOISES: dict[str, Callable[[Rng, FloatArray, int], NDArray[Any]]] = {
    "sensor": lambda rng, image, m: image + SENSOR_SD * gaussian(rng, m),
    "salt": _salted,  # a tenth of the pixels are black or white
    "speckle": lambda rng, image, m: image * (1 + 0.3 * gaussian(rng, m)),  # of a laser, a radar
    "shot": lambda rng, image, m: 25.5 * rng.poisson(image / 25.5, (m, HEIGHT, WIDTH)),
}


def bands(rng: Rng, n: int) -> Footage:
    """A still image with the rolling bands of a lamp that is not in step with the shutter."""
    image = soft_image(rng)
    phase = np.cumsum(rng.normal(2.4, 0.4, n))
    rows = 2 * np.pi * np.arange(HEIGHT) / 24

    def seen(at: int, m: int) -> NDArray[Any]:
        rolling = 20 * np.cos(rows - phase[at : at + m, None])[:, :, None]
        return NOISES["sensor"](rng, image + rolling, m)

    return stateless(in_pieces(n, seen))


# Cameras.


def flicker(rng: Rng, plain: Footage) -> Footage:
    """Frames whose exposure differs by 10 % each; a sensor's noise of 5."""

    def seen(at: int, m: int) -> NDArray[Any]:
        exposure = rng.normal(1, 0.1, (m, 1, 1))
        return plain.frames[at : at + m] * exposure + 5 * gaussian(rng, m)

    return replace(plain, frames=in_pieces(len(plain.frames), seen))


def shake(rng: Rng, plain: Footage) -> Footage:
    """Frames each off by a pixel at most, to any side."""
    _, height, width = plain.frames.shape
    moves = rng.integers(0, 3, (len(plain.frames), 2))
    wide = np.pad(plain.frames, ((0, 0), (1, 1), (1, 1)), mode="edge")
    shaken = [
        frame[y : y + height, x : x + width] for frame, (y, x) in zip(wide, moves, strict=True)
    ]
    return replace(plain, frames=np.array(shaken))


def lit(rng: Rng, plain: Footage) -> Footage:
    """Frames in a light that changes, some 250 frames a cycle: a second cause."""
    cause = 1 + 0.2 * np.tanh(wandering(rng, len(plain.frames), 40))
    exposure = cause[:, None, None]
    return _caused(plain, cause, lambda at, m: plain.frames[at : at + m] * exposure[at : at + m])


def occluded(rng: Rng, plain: Footage) -> Footage:
    """Frames before which a dark disc passes to and fro, a fifth of the width: a second cause."""
    n, height, width = plain.frames.shape
    place = 0.5 + 0.5 * np.sin(wandering(rng, n, 25))
    y, x = np.mgrid[:height, :width]

    def seen(at: int, m: int) -> NDArray[Any]:
        middle = (width * place[at : at + m])[:, None, None]
        behind = (x - middle) ** 2 + (y - height / 2) ** 2 < (width / 5) ** 2
        return np.where(behind, 20.0, plain.frames[at : at + m])

    return _caused(plain, place, seen)


def _caused(plain: Footage, cause: FloatArray, seen: Callable[[int, int], Any]) -> Footage:
    frames = in_pieces(len(plain.frames), seen)
    return Footage(frames, np.column_stack([plain.state, cause]))


def pausing(rng: Rng, plain: Footage) -> Footage:
    """Return frames that are constant half of the time, 300 at once on average."""
    n = len(plain.frames)
    lengths = rng.exponential(300, 4 * n // 300 + 100).astype(int) + 1
    moving = np.repeat(np.arange(len(lengths)) % 2 == 0, lengths)[:n]
    rows = np.cumsum(moving) - 1
    return replace(plain, frames=plain.frames[rows], state=plain.state[rows])


CAMERAS: dict[str, Callable[[Rng, Footage], Footage]] = {
    "flicker": flicker,
    "shake": shake,
    "lit": lit,
    "occluded": occluded,
    "pausing": pausing,
}
