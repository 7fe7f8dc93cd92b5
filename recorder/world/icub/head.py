"""The robot's joints: turns of its head, the path of a roaming head, arms at rest."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from cdmisfa.core.arrays import FloatArray

# The view of a roaming head, and the column of truth with its angle to the left.
ROAM, YAW = "roam", "head_yaw"

# Frames after which a roaming head may turn to another view.
FRAMES_OF_A_LOOK = 60

# Degrees that a roaming head turns in a frame by default; `scene.transit` changes it.
ROAMS_BY = 7.5

# Degrees in a frame below which the head jumps: a turn would take thousands of frames.
SLOWEST_TURN = 0.1

# Angles of the joints of both arms where they rest on the table, degrees; without l_ and r_.
ARMS = {
    "shoulder_pitch": -30.0,
    "shoulder_roll": 30.0,
    "shoulder_yaw": 15.0,
    "elbow": 50.0,
    "wrist_prosup": 60.0,
}

_ROAM, _DIGITS = 0x40A3, 6


# Origins of iCub v2.5's joints of the neck, that of its yaw while its pitch is 0; root frame.
NECK, NECK_PITCH = (-0.010809, 0.0, 0.241953), (-0.010809, 0.0, 0.254797)

Place = tuple[float, float, float]


def bent(vector: Place, pitch: float) -> FloatArray:
    """Rotate a vector of a level head, (3,), root frame, as the neck bends upwards, degrees."""
    cos, sin = math.cos(math.radians(pitch)), math.sin(math.radians(pitch))
    x, y, z = vector
    return np.array([cos * x + sin * z, y, cos * z - sin * x])


def neck_at(pitch: float) -> Place:
    """Return the origin of the neck's yaw joint, root frame, as the neck bends upwards, degrees."""
    if not pitch:
        return NECK
    (x, y, z), (a, b, c) = NECK, NECK_PITCH
    moved = bent((x - a, y - b, z - c), pitch)
    return a + float(moved[0]), b + float(moved[1]), c + float(moved[2])


def quaternion(yaw: float, pitch: float) -> tuple[float, float, float, float]:
    """Return the rotation of a head, root frame, (x, y, z, w); degrees to the left and upwards."""
    a, b = math.radians(yaw) / 2, math.radians(pitch) / 2
    across, along = math.sin(b), math.cos(b)
    # + 0.0 removes the sign of a zero, which recordings of a level head never had.
    sin, cos = math.sin(a), math.cos(a)
    return across * sin + 0.0, across * cos + 0.0, along * sin, along * cos


def turn_frames(degrees: float, transit: float) -> int:
    """Return the frames of a turn by `transit` degrees a frame in the mean; 0 if the head jumps."""
    if not transit >= SLOWEST_TURN:
        return 0
    return math.ceil(max(0.0, min(abs(degrees), 360.0)) / transit)  # logs may state any


def turn(start: float, stop: float, frames: int) -> list[float]:
    """Return the angles of a minimum-jerk turn, without the frame at which it has ended."""
    shares = [(i + 1) / (frames + 1) for i in range(frames)]
    path = (start + (stop - start) * s * s * s * (10 - 15 * s + 6 * s * s) for s in shares)
    return [round(angle, _DIGITS) for angle in path]


def turns(yaw: Sequence[float], transit: float, *, roam: bool) -> tuple[tuple[int, ...], ...]:
    """Return the frames that a change between each two views loses, [from][to].

    The place of a roaming head is unknown: changes to and from its view take the longest turn.

    Args:
        yaw: of the head in each view, degrees.
        transit: degrees that the head turns in a frame; 0 if it jumps.
        roam: whether the last view is of a roaming head.
    """
    frames = [[turn_frames(b - a, transit) for b in yaw] for a in yaw]
    if roam:
        longest = max(map(max, frames))
        frames = [*([*row, longest] for row in frames), [*[longest] * len(yaw), 0]]
    return tuple(map(tuple, frames))


class Roaming:
    """The path of a roaming head, which chooses a view every `FRAMES_OF_A_LOOK`.

    Args:
        yaw: of the views, degrees.
        transit: degrees that the head turns in a frame; 0 for `ROAMS_BY`.
        seed: of the choices.
    """

    def __init__(self, yaw: Sequence[float], transit: float, seed: int) -> None:
        self._yaw, self._transit, self._seed = yaw, transit or ROAMS_BY, seed
        self._look = lru_cache(maxsize=4)(self._path)

    def angles(self, start: int, n: int) -> list[float]:
        """Return the degrees to the left at n frames from `start` on."""
        places = (divmod(t, FRAMES_OF_A_LOOK) for t in range(start, start + n))
        return [self._look(look)[frame] for look, frame in places]

    def _path(self, look: int) -> list[float]:
        before, now = (self._yaw[self._chosen(max(i, 0))] for i in (look - 1, look))
        frames = min(turn_frames(now - before, self._transit), FRAMES_OF_A_LOOK - 1)
        return [*turn(before, now, frames), *[now] * (FRAMES_OF_A_LOOK - frames)]

    def _chosen(self, look: int) -> int:
        bits = np.random.Philox(key=np.array([self._seed, _ROAM], np.uint64))
        bits.advance(look)
        return int(bits.random_raw() % len(self._yaw))
