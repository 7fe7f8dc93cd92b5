"""What stands where in the iCub scene, as recordings and runs state its configuration.

The robot's root frame is x to the back, y to the right, z up, in metres; the paper's y, which the
ground truth has, goes to the left. A camera's frame is x to the right, y down, z along its gaze.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.blocks import HeadPose
from cdmisfa.core.errors import LogDamagedError
from recorder.world.icub.config import TABLE_FROM, TABLE_TO
from recorder.world.icub.head import (
    ARMS,
    ROAM,
    YAW,
    neck_at,
    quaternion,
    turn,
    turn_frames,
    turns,
)
from recorder.world.icub.room import painted

KIND = "icub"
"""The scene that is described here."""

ROAMING = ROAM, YAW
"""The view of a head that roams, and the truth's name of how far that is turned to the left."""

Quaternion = tuple[float, float, float, float]
"""A turn as (x, y, z, w)."""

Place = tuple[float, float, float]

_GAZE: Quaternion = (-0.5, -0.5, 0.5, 0.5)
"""From a camera's frame to that of a head that looks straight on: its z goes to -x."""


@dataclass(frozen=True, slots=True)
class Thing:
    """Something on the table, or the table.

    Attributes:
        name: what it is.
        shape: "box", "cylinder" or "sphere".
        size: its extent along x, y and z.
        colour: red, green and blue, 0 to 1.
        place: its centre; x and y of an object are where the truth says.
        truth: names of the truth's columns that say so; none of what stands still.
    """

    name: str
    shape: str
    size: Place
    colour: tuple[float, float, float]
    place: Place
    truth: tuple[str, ...] = ()

    def places(self, names: Sequence[str], truth: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, 3) where its centre is at frames with this (n, D) truth, whose columns have names."""
        x, y = (truth[:, list(names).index(name)] for name in self.truth)
        return np.stack([x, -y, np.full(len(truth), self.place[2])], axis=1)


@dataclass(frozen=True, slots=True)
class Eye:
    """A camera: where it is, and how it maps what is in front of it.

    Attributes:
        place: of its centre.
        turn: from its frame to the root's.
        width: pixels of its image, as height.
        focal: length in pixels, in both directions.
    """

    place: Place
    turn: Quaternion
    width: int
    height: int
    focal: float


@dataclass(frozen=True, slots=True)
class Gaze:
    """A view: how the head is turned for it, and its eyes.

    Attributes:
        name: of the view.
        yaw: of the neck, degrees to the left.
        pitch: of the neck, degrees upwards.
        tilt: of the eyes, degrees upwards.
        head: the head's pose.
        middle: an eye between the two.
        eyes: the left one and the right one.
    """

    name: str
    yaw: float
    pitch: float
    tilt: float
    head: HeadPose
    middle: Eye
    eyes: tuple[Eye, Eye]


@dataclass(frozen=True, slots=True)
class Scenery:
    """A robot and what is in front of it.

    Attributes:
        robot: a model of the icub-models package.
        gazes: one for each view.
        table: which stands still.
        objects: which move.
        eyes: their measures, keys `scene.eyes.*`.
        transit: degrees that the head turns in a frame; 0 where it jumps.
        arms: angles of the arms' joints, degrees, where they do not hang.
    """

    robot: str
    gazes: tuple[Gaze, ...]
    table: Thing
    objects: tuple[Thing, ...]
    eyes: Mapping[str, Any]
    transit: float = 0.0
    arms: Mapping[str, float] = field(default_factory=dict)

    def gaze(self, view: str) -> Gaze | None:
        """The gaze of a view, None where there is no such view."""
        return next((gaze for gaze in self.gazes if gaze.name == view), None)

    def turned(self, gaze: Gaze, yaw: float) -> Gaze:
        """A gaze with the head turned otherwise, degrees to the left."""
        return _gaze(gaze.name, yaw, self.eyes, gaze.head.position)

    def way(self, before: Gaze, after: Gaze) -> list[Gaze]:
        """Where the head looks at the frames that are lost as it turns from one to the other."""
        frames = turn_frames(after.yaw - before.yaw, self.transit)
        return [self.turned(after, yaw) for yaw in turn(before.yaw, after.yaw, frames)]


def scenery_of(config: Mapping[str, Any], neck: Place | None = None) -> Scenery | None:
    """What a scene's configuration (`scene.*`) says.

    Args:
        config: the table, as `as_table` gives it.
        neck: origin of the neck yaw joint; by default that of iCub v2.5.

    Returns:
        None of another scene.

    Raises:
        LogDamagedError: it is one of the iCub scene, and keys are missing or make no sense.
    """
    if config.get("kind") != KIND:
        return None
    try:
        eyes, table = config["eyes"], config["table"]
        views = zip(eyes["views"], eyes["yaw"], strict=True)
        neck = neck_at(float(eyes.get("pitch", 0.0))) if neck is None else neck
        gazes = tuple(_gaze(str(name), float(yaw), eyes, neck) for name, yaw in views)
        top, thickness = float(table["top"]), float(table["thickness"])
        near, far = np.array(TABLE_FROM), np.array(TABLE_TO)
        x, y = ((near + far) / 2).tolist()
        length, width = (far - near).tolist()
        red, green, blue = (float(part) for part in _paint(config, "table") or table["colour"])
        return Scenery(
            robot=str(config["robot"]),
            gazes=gazes,
            table=Thing(
                *("table", "box", (length, width, thickness), (red, green, blue)),
                place=(x, y, top - thickness / 2),
            ),
            objects=_objects(config, top),
            eyes=eyes,
            transit=float(config.get("transit", 0.0)),
            arms={s + joint: a for joint, a in ARMS.items() for s in ("l_", "r_")}
            if config.get("arms")
            else {},
        )
    except (KeyError, TypeError, ValueError) as error:
        raise LogDamagedError(f"the configuration of the scene is broken ({error})") from error


def turns_of(config: Mapping[str, Any], streams: Sequence[int]) -> tuple[tuple[int, ...], ...]:
    """Frames that are lost between each two streams as the head turns, [from][to].

    Args:
        config: of the scene, as a recording states it.
        streams: their places among the scene's.

    Returns:
        None of a scene whose head jumps, or has none.
    """
    if not config.get("transit"):
        return ()
    try:
        yaw, transit = config["eyes"]["yaw"], float(config["transit"])
        table = turns(yaw, transit, roam=bool(config.get("roam")))
        return tuple(tuple(table[a][b] for b in streams) for a in streams)
    except (LookupError, TypeError, ValueError):
        return ()


def _paint(config: Mapping[str, Any], name: str) -> tuple[float, float, float] | None:
    """The colour of a thing where it is painted."""
    return painted(name) if config.get("texture") else None


def _objects(config: Mapping[str, Any], top: float) -> tuple[Thing, ...]:
    """The box, the cylinder and the ball, which stand on the table."""
    box, cylinder, ball = (config[f"object{i}"] for i in (1, 2, 3))
    edge, across, high = 2 * box["half_size"], 2 * cylinder["radius"], cylinder["height"]
    round_ = 2 * ball["radius"]
    found = (
        ("box", "box", (edge, edge, edge), box),
        ("cylinder", "cylinder", (across, across, high), cylinder),
        ("ball", "sphere", (round_, round_, round_), ball),
    )
    return tuple(
        Thing(
            *(name, shape, size, _paint(config, name) or (float(table["grey"]),) * 3),
            place=(sum(table["x"]) / 2, -sum(table["y"]) / 2, top + size[2] / 2),
            truth=(f"object{i}_x", f"object{i}_y"),
        )
        for i, (name, shape, size, table) in enumerate(found, 1)
    )


def _gaze(name: str, yaw: float, eyes: Mapping[str, Any], neck: Place) -> Gaze:
    tilt, pitch = float(eyes["tilt"]), float(eyes.get("pitch", 0.0))
    head = quaternion(yaw, pitch)
    sink = math.radians(tilt) / 2
    turn = times(times(head, (0.0, math.sin(sink), 0.0, math.cos(sink))), _GAZE)
    height, width = int(eyes["height"]), int(eyes["width"])
    focal = height / 2 / math.tan(math.radians(eyes["vertical_fov"]) / 2)

    def eye(left: float) -> Eye:
        offset = turned(head, (-eyes["forward"], -left, eyes["up"]))
        x, y, z = (np.array(neck) + offset).tolist()
        return Eye((x, y, z), turn, width, height, focal)

    beside = float(eyes["half_distance"])
    both = eye(beside), eye(-beside)
    return Gaze(name, yaw, pitch, tilt, HeadPose(neck, head), eye(0.0), both)


def times(first: Quaternion, second: Quaternion) -> Quaternion:
    """Product of two quaternions: turn by the second, then by the first."""
    (a, b, c, w), (x, y, z, v) = first, second
    return (
        w * x + a * v + b * z - c * y,
        w * y - a * z + b * v + c * x,
        w * z + a * y - b * x + c * v,
        w * v - a * x - b * y - c * z,
    )


def inverse(turn: Quaternion) -> Quaternion:
    """Inverse of a unit quaternion."""
    x, y, z, w = turn
    return -x, -y, -z, w


def turned(turn: Quaternion, vector: Sequence[float]) -> NDArray[np.float64]:
    """Rotate a vector by a unit quaternion, (3,)."""
    axis, straight = np.array(turn[:3]), np.array(vector, dtype=np.float64)
    across = 2 * np.cross(axis, straight)
    return np.asarray(straight + turn[3] * across + np.cross(axis, across))
