"""What a camera, or what is before it, does to any stream of pictures: footage to footage."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray
from cdmisfa.studies.arena.pictures import Footage, Rng, gaussian, in_pieces, wandering

LIGHT: Final = 40
"""Frames of the memory of a light that changes, see `wandering`: some 250 to come and go."""

PASSING: Final = 25
"""The same of what passes before the camera."""

STRETCH: Final = 300
"""Frames that a picture which pauses moves, or stands still, in the mean."""

Camera = Callable[[Rng, Footage], Footage]


def flicker(rng: Rng, plain: Footage) -> Footage:
    """Frames whose exposure differs by 10 % each; a sensor's noise of 5."""

    def seen(at: int, n: int) -> NDArray[np.floating]:
        exposure = rng.normal(1, 0.1, (n, 1, 1))
        return np.asarray(plain.frames[at : at + n] * exposure + 5 * gaussian(rng, n))

    return _seen(plain, seen)


def shake(rng: Rng, plain: Footage) -> Footage:
    """Frames each off by a pixel at most, to any side."""
    moves = rng.integers(0, 3, (len(plain.frames), 2))
    shaken = np.empty_like(plain.frames)
    for frame, out, (down, right) in zip(plain.frames, shaken, moves, strict=True):
        wide = np.pad(frame, 1, mode="edge")
        out[:] = wide[down : down + frame.shape[0], right : right + frame.shape[1]]
    return replace(plain, frames=shaken)


def low_contrast(rng: Rng, plain: Footage) -> Footage:
    """Frames at a tenth of the contrast, about their mean picture."""
    frames, mean = plain.frames, plain.frames.mean(axis=0)
    return _seen(plain, lambda at, n: mean + 0.1 * (frames[at : at + n] - mean))


def lit(rng: Rng, plain: Footage) -> Footage:
    """Frames in a light that changes: a second cause, beside what the stream shows."""
    light = 1 + 0.2 * np.tanh(wandering(rng, len(plain.frames), LIGHT))
    exposure = light[:, None, None]
    found = _seen(plain, lambda at, n: plain.frames[at : at + n] * exposure[at : at + n])
    return _also(found, light, "light")


def occluded(rng: Rng, plain: Footage) -> Footage:
    """Frames before which a dark disc passes to and fro, a fifth of the width."""
    n, height, width = plain.frames.shape
    place = 0.5 + 0.5 * np.sin(wandering(rng, n, PASSING))
    y, x = np.mgrid[:height, :width]

    def seen(at: int, m: int) -> NDArray[np.floating]:
        middle = (width * place[at : at + m])[:, None, None]
        behind = (x - middle) ** 2 + (y - height / 2) ** 2 < (width / 5) ** 2
        return np.where(behind, 20.0, plain.frames[at : at + m])

    return _also(_seen(plain, seen), place, "occluder")


def pausing(rng: Rng, plain: Footage) -> Footage:
    """Frames that stand still for long, now and then: half of the time, `STRETCH` at once."""
    n = len(plain.frames)
    lengths = rng.exponential(STRETCH, 4 * n // STRETCH + 100).astype(int) + 1
    moving = np.repeat(np.arange(len(lengths)) % 2 == 0, lengths)[:n]
    shown = np.cumsum(moving) - 1
    return replace(plain, frames=plain.frames[shown], state=plain.state[shown])


def side(turned: float = 0.0, nearer: float = 1.0, aside: float = 0.0) -> Camera:
    """A camera that sees the same world from another side; what lies beyond its edge is drawn out.

    Args:
        turned: about its axis, in degrees.
        nearer: times as large as it is seen.
        aside: moved, to the right and down, as a share of the height.
    """

    def seen(_: Rng, plain: Footage) -> Footage:
        shape = np.array(plain.frames.shape[1:])
        middle = (shape[:, None, None] - 1) / 2
        y, x = np.mgrid[: shape[0], : shape[1]] - middle
        sine, cosine = np.sin(np.deg2rad(turned)), np.cos(np.deg2rad(turned))
        there = np.stack([cosine * y + sine * x, cosine * x - sine * y]) / nearer
        there = (there + middle + aside * shape[0]).round().astype(int)
        row, column = there.clip(0, shape[:, None, None] - 1)
        return replace(plain, frames=plain.frames[:, row, column])

    return seen


def darker(rng: Rng, plain: Footage) -> Footage:
    """Frames half as bright."""
    return replace(plain, frames=plain.frames // 2)


SIDES: Final = {
    "moved": side(aside=0.1),
    "turned": side(turned=12),
    "nearer": side(nearer=1.2),
    "darker": darker,
}
"""Cameras that see the same world as a good one, otherwise."""


def _seen(plain: Footage, seen: Callable[[int, int], NDArray[np.floating]]) -> Footage:
    return replace(plain, frames=in_pieces(len(plain.frames), seen).frames)


def _also(footage: Footage, cause: FloatArray, name: str) -> Footage:
    """Footage, one more cause of which is known."""
    state = np.concatenate([footage.state, cause[:, None]], axis=1)
    return replace(footage, state=state, names=(*footage.names, name))
