"""Joints of the robot: rotation of its head, path of a roaming head, arms at rest."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from cdmisfa.core.arrays import FloatArray

# Name of the view of a roaming head, and of the column of truth with its angle (degrees to the
# left).
ROAM, YAW = "roam", "head_yaw"

# Frames between two choices of a roaming head. Set by hand.
LOOK_FRAMES = 60

# Default mean angle that a roaming head turns in a frame, degrees; `scene.transit` changes it. Set
# by hand: it is 60 degrees a second at the default 8 frames a second.
ROAM_TRANSIT = 7.5

# Angle in a frame below which the head jumps (degrees): a turn would take thousands of frames.
MIN_TRANSIT = 0.1

# Angles of the joints of both arms at rest on the table (degrees); without the prefix l_ or r_.
ARMS = {
    "shoulder_pitch": -30.0,
    "shoulder_roll": 30.0,
    "shoulder_yaw": 15.0,
    "elbow": 50.0,
    "wrist_prosup": 60.0,
}

# Stream number of the random choices, and decimals of angles (those beyond can differ with the
# machine's sine and cosine).
_ROAM, _DIGITS = 0x40A3, 6


# Origins of iCub v2.5's neck joints in the root frame (m), that of the yaw joint at pitch 0.
NECK, NECK_PITCH = (-0.010809, 0.0, 0.241953), (-0.010809, 0.0, 0.254797)

Place = tuple[float, float, float]


def bent(vector: Place, pitch: float) -> FloatArray:
    """Rotate a vector of a level head, (3,) in the root frame, by a pitch (degrees upwards)."""
    cos, sin = math.cos(math.radians(pitch)), math.sin(math.radians(pitch))
    x, y, z = vector
    return np.array([cos * x + sin * z, y, cos * z - sin * x])


def neck_at(pitch: float) -> Place:
    """Return the origin of the neck's yaw joint in the root frame (m) at a pitch (degrees)."""
    if not pitch:
        return NECK
    (x, y, z), (a, b, c) = NECK, NECK_PITCH
    moved = bent((x - a, y - b, z - c), pitch)
    return a + float(moved[0]), b + float(moved[1]), c + float(moved[2])


def quaternion(yaw: float, pitch: float) -> tuple[float, float, float, float]:
    """Return the rotation of a head, (x, y, z, w) in the root frame; degrees left and upwards."""
    a, b = math.radians(yaw) / 2, math.radians(pitch) / 2
    across, along = math.sin(b), math.cos(b)
    # + 0.0 removes the sign of a zero: early recordings of a level head do not have it.
    sin, cos = math.sin(a), math.cos(a)
    return across * sin + 0.0, across * cos + 0.0, along * sin, along * cos


def turn_frames(degrees: float, transit: float) -> int:
    """Return the number of frames of a turn at a mean of `transit` degrees; 0 if the head jumps."""
    if not transit >= MIN_TRANSIT:
        return 0
    return math.ceil(max(0.0, min(abs(degrees), 360.0)) / transit)  # logs may state any angle


def turn(start: float, stop: float, frames: int) -> list[float]:
    """Return the angles of a minimum-jerk turn, without its last frame."""
    shares = [(i + 1) / (frames + 1) for i in range(frames)]
    path = (start + (stop - start) * s * s * s * (10 - 15 * s + 6 * s * s) for s in shares)
    return [round(angle, _DIGITS) for angle in path]


def turns(yaw: Sequence[float], transit: float, *, roam: bool) -> tuple[tuple[int, ...], ...]:
    """Return the number of frames that a change between each two views loses, [from][to].

    The angle of a roaming head is unknown: changes to and from its view take the longest turn.

    Args:
        yaw: angle of the head in each view (degrees).
        transit: mean angle that the head turns in a frame (degrees); 0 if it jumps.
        roam: True if the last view is of a roaming head.
    """
    frames = [[turn_frames(b - a, transit) for b in yaw] for a in yaw]
    if roam:
        longest = max(map(max, frames))
        frames = [*([*row, longest] for row in frames), [*[longest] * len(yaw), 0]]
    return tuple(map(tuple, frames))


class Roaming:
    """Path of a roaming head, which chooses a view every `LOOK_FRAMES`.

    Args:
        yaw: angle of the head in each view (degrees).
        transit: mean angle that the head turns in a frame (degrees); 0 for `ROAM_TRANSIT`.
        seed: seed of the choices.
    """

    def __init__(self, yaw: Sequence[float], transit: float, seed: int) -> None:
        self._yaw, self._transit, self._seed = yaw, transit or ROAM_TRANSIT, seed
        self._look = lru_cache(maxsize=4)(self._path)

    def angles(self, start: int, n: int) -> list[float]:
        """Return the angles (degrees to the left) at n frames from `start` on."""
        places = (divmod(t, LOOK_FRAMES) for t in range(start, start + n))
        return [self._look(look)[frame] for look, frame in places]

    def _path(self, look: int) -> list[float]:
        before, now = (self._yaw[self._chosen(max(i, 0))] for i in (look - 1, look))
        frames = min(turn_frames(now - before, self._transit), LOOK_FRAMES - 1)
        return [*turn(before, now, frames), *[now] * (LOOK_FRAMES - frames)]

    def _chosen(self, look: int) -> int:
        bits = np.random.Philox(key=np.array([self._seed, _ROAM], np.uint64))
        bits.advance(look)
        return int(bits.random_raw() % len(self._yaw))
