"""What a stream shows; and streams that numpy makes: noise, pictures, drifting light, waves.

The makers take a generator and the number of frames.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from cdmisfa.core.arrays import FloatArray

HEIGHT, WIDTH = 48, 64
"""Of the grey pictures of all cameras."""

Rng = np.random.Generator


@dataclass(frozen=True, slots=True)
class Shown:
    """The frames of a stream, with the state of the world behind each where there is one.

    Attributes:
        frames: (n, *frame_shape), uint8 pixels or float64 values.
        state: (n, C) float64; C may be 0.
        names: a name for each column of `state`.
    """

    frames: NDArray[Any]
    state: FloatArray
    names: tuple[str, ...] = ()


def stateless(frames: NDArray[Any]) -> Shown:
    """Frames, (n, *frame_shape), behind which there is nothing to be known."""
    return Shown(frames, np.zeros((len(frames), 0)))


def pixels(values: NDArray[Any]) -> NDArray[np.uint8]:
    """Values, of any shape, as pixels: rounded, and cut off at black and white."""
    return np.asarray(np.rint(values).clip(0, 255), np.uint8)


GREY = 127.5
"""The middle of the range of pixels."""

HOLD = 10
"""Frames for which a jumping picture stands still."""

SENSOR_SD = 3.0
"""Of the noise of a sensor, in steps of a pixel."""

PIECE = 1000
"""Frames that are made at once."""


def full_noise(rng: Rng, n: int) -> Shown:
    """Every pixel of every frame drawn from all 256 values."""
    return stateless(rng.integers(0, 256, (n, HEIGHT, WIDTH), dtype=np.uint8))


def gaussian(sd: float) -> Callable[[Rng, int], Shown]:
    """Gaussian noise about grey, its standard deviation as a share of the full range."""
    return lambda rng, n: _frames(n, lambda m: GREY + 255 * sd * _normal(rng, m))


def uniform(sd: float) -> Callable[[Rng, int], Shown]:
    """Uniform noise about grey, its standard deviation as a share of the full range."""
    half = 255 * sd * np.sqrt(3.0)
    return lambda rng, n: _frames(
        n, lambda m: GREY + half * (2 * rng.random((m, HEIGHT, WIDTH), np.float32) - 1)
    )


def vector_noise(rng: Rng, n: int) -> Shown:
    """Gaussian noise of standard deviation 1 in two values, beside the oscillatory streams."""
    return stateless(rng.standard_normal((n, 2)))


def jumping(rng: Rng, n: int) -> Shown:
    """Another picture every `HOLD` frames."""
    shown = np.stack([picture(rng) for _ in range(-(-n // HOLD))])
    return stateless(np.repeat(pixels(shown), HOLD, axis=0)[:n])


def constant(rng: Rng, n: int) -> Shown:
    """One grey."""
    return stateless(np.full((n, HEIGHT, WIDTH), 90, np.uint8))


def still(rng: Rng, n: int) -> Shown:
    """A picture that stands still, seen through a sensor's noise."""
    shown = picture(rng)
    return _frames(n, lambda m: shown + SENSOR_SD * _normal(rng, m))


def light(rng: Rng, n: int) -> Shown:
    """A picture whose brightness drifts, seen through a sensor's noise."""
    shown = picture(rng)
    brightness = 30 * np.sin(np.cumsum(rng.normal(0, 0.5, n)) / 10)
    pieces = iter(np.split(brightness, range(PIECE, n, PIECE)))
    frames = _frames(
        n, lambda m: shown + next(pieces)[:, None, None] + SENSOR_SD * _normal(rng, m)
    ).frames
    return Shown(frames, brightness[:, None], ("brightness",))


def waves(rng: Rng, n: int) -> Shown:
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
    return Shown(frames, np.stack([np.cos(phase), np.sin(phase)], axis=1), ("cos", "sin"))


def picture(rng: Rng) -> FloatArray:
    """A picture of soft patches, (HEIGHT, WIDTH)."""
    patches = Image.fromarray(rng.standard_normal((6, 8)).astype(np.float32))
    smooth = patches.resize((WIDTH, HEIGHT), Image.Resampling.BICUBIC)
    return np.asarray(128 + 40 * np.asarray(smooth, np.float64)).clip(0, 255)


# What a bad camera does to any stream.


def flicker(rng: Rng, frames: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Frames, (n, height, width), whose exposure differs by 10 % each; a sensor's noise of 5."""
    return _filtered(
        frames,
        lambda part: part * rng.normal(1, 0.1, (len(part), 1, 1)) + 5 * _normal(rng, len(part)),
    )


def shake(rng: Rng, frames: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Frames, (n, height, width), each off by a pixel at most, to any side."""
    moves = rng.integers(0, 3, (len(frames), 2))
    shaken = np.empty_like(frames)
    for frame, out, (down, right) in zip(frames, shaken, moves, strict=True):
        wide = np.pad(frame, 1, mode="edge")
        out[:] = wide[down : down + frame.shape[0], right : right + frame.shape[1]]
    return shaken


def dim(rng: Rng, frames: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Frames, (n, height, width), at a tenth of the contrast, about their mean picture."""
    mean = frames.mean(axis=0)
    return _filtered(frames, lambda part: mean + 0.1 * (part - mean))


def _normal(rng: Rng, n: int) -> NDArray[np.float32]:
    return rng.standard_normal((n, HEIGHT, WIDTH), np.float32)


def _frames(n: int, make: Callable[[int], NDArray[np.floating]]) -> Shown:
    """So many frames, made a piece at a time."""
    lengths = (min(PIECE, n - start) for start in range(0, n, PIECE))
    return stateless(np.concatenate([pixels(make(m)) for m in lengths]))


def _filtered(
    frames: NDArray[np.uint8], change: Callable[[NDArray[np.uint8]], NDArray[np.floating]]
) -> NDArray[np.uint8]:
    def pieces() -> Iterator[NDArray[np.uint8]]:
        for start in range(0, len(frames), PIECE):
            yield pixels(change(frames[start : start + PIECE]))

    return np.concatenate(list(pieces()))
