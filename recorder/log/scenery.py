"""Geometry of the iCub scene: poses of head, eyes and objects, from a recording's configuration.

The robot's root frame has x to the back, y to the right, z up, in metres. The paper's y, which the
ground truth uses, points to the left. A camera's frame has x to the right, y down, z along its
gaze.
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
from recorder.world.icub.head import ARMS, ROAM, YAW, neck_at, quaternion, turn, turn_frames, turns
from recorder.world.icub.room import painted

KIND = "icub"  # name of the scene

# Name of the view of a roaming head, and of the column of truth with its yaw (degrees to the left).
ROAMING = ROAM, YAW

Quaternion = tuple[float, float, float, float]  # (x, y, z, w)
Place = tuple[float, float, float]

# Rotation from a camera's frame to that of a head that looks straight ahead: its z becomes -x.
_GAZE: Quaternion = (-0.5, -0.5, 0.5, 0.5)


@dataclass(frozen=True, slots=True)
class Thing:
    """An object on the table, or the table itself.

    Attributes:
        name: name of the object.
        shape: "box", "cylinder" or "sphere".
        size: extent along x, y and z (m).
        colour: red, green and blue, 0 to 1.
        place: centre (m); for a moving object the truth has x and y.
        truth: names of the columns of truth with x and y; empty if the object does not move.
    """

    name: str
    shape: str
    size: Place
    colour: tuple[float, float, float]
    place: Place
    truth: tuple[str, ...] = ()

    def places(self, names: Sequence[str], truth: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the centre (n, 3) in m for rows (n, D) of truth, whose columns have `names`."""
        x, y = (truth[:, list(names).index(name)] for name in self.truth)
        return np.stack([x, -y, np.full(len(truth), self.place[2])], axis=1)


@dataclass(frozen=True, slots=True)
class Eye:
    """A camera: its pose and its focal length.

    Attributes:
        place: centre of the camera (m).
        turn: rotation from its frame to the root frame.
        width: width of the image (pixels).
        height: height of the image (pixels).
        focal: focal length in both directions (pixels).
    """

    place: Place
    turn: Quaternion
    width: int
    height: int
    focal: float


@dataclass(frozen=True, slots=True)
class Gaze:
    """A view: the rotation of the head, and its eyes.

    Attributes:
        name: name of the view.
        yaw: angle of the neck (degrees to the left).
        pitch: angle of the neck (degrees upwards).
        tilt: angle of the eyes (degrees upwards).
        head: pose of the head.
        middle: a camera in the middle between both eyes.
        eyes: the left and the right eye.
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
    """The robot, the table and the objects on it.

    Attributes:
        robot: name of a model in the icub-models package.
        gazes: one gaze for each view.
        table: the table.
        objects: the moving objects.
        eyes: dimensions of the eyes, the keys `scene.eyes.*`.
        transit: mean angle that the head turns in a frame (degrees); 0 if it jumps.
        arms: angles of the arms' joints (degrees); empty if the arms hang.
    """

    robot: str
    gazes: tuple[Gaze, ...]
    table: Thing
    objects: tuple[Thing, ...]
    eyes: Mapping[str, Any]
    transit: float = 0.0
    arms: Mapping[str, float] = field(default_factory=dict)

    def gaze(self, view: str) -> Gaze | None:
        """Return the gaze of a view, or None."""
        return next((gaze for gaze in self.gazes if gaze.name == view), None)

    def turned(self, gaze: Gaze, yaw: float) -> Gaze:
        """Return a gaze with another yaw of the head (degrees to the left)."""
        return _gaze(gaze.name, yaw, self.eyes, gaze.head.position)

    def way(self, before: Gaze, after: Gaze) -> list[Gaze]:
        """Return the gazes at the frames that are lost while the head turns."""
        frames = turn_frames(after.yaw - before.yaw, self.transit)
        return [self.turned(after, yaw) for yaw in turn(before.yaw, after.yaw, frames)]


def scenery_of(config: Mapping[str, Any], neck: Place | None = None) -> Scenery | None:
    """Return the scenery of a scene's configuration; None if it is not the iCub scene.

    Args:
        config: the table `scene` of a recording.
        neck: origin of the neck yaw joint (m); None: that of iCub v2.5.

    Raises:
        LogDamagedError: keys are missing or not valid.
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
        size, place = (length, width, thickness), (x, y, top - thickness / 2)
        arms = {s + joint: a for joint, a in ARMS.items() for s in ("l_", "r_")}
        return Scenery(
            robot=str(config["robot"]),
            gazes=gazes,
            table=Thing("table", "box", size, (red, green, blue), place),
            objects=_objects(config, top),
            eyes=eyes,
            transit=float(config.get("transit", 0.0)),
            arms=arms if config.get("arms") else {},
        )
    except (KeyError, TypeError, ValueError) as error:
        raise LogDamagedError(f"the scene's configuration is damaged ({error})") from error


def turns_of(config: Mapping[str, Any], streams: Sequence[int]) -> tuple[tuple[int, ...], ...]:
    """Return the number of frames lost between each two streams while the head turns, [from][to].

    Args:
        config: the table `scene` of a recording; without turns the result is empty.
        streams: indices of the streams in the scene.
    """
    try:
        if not config.get("transit"):
            return ()
        yaw, transit = config["eyes"]["yaw"], float(config["transit"])
        table = turns(yaw, transit, roam=bool(config.get("roam")))
        return tuple(tuple(table[a][b] for b in streams) for a in streams)
    except (LookupError, TypeError, ValueError):
        return ()


def _paint(config: Mapping[str, Any], name: str) -> tuple[float, float, float] | None:
    """Return the color of an object that has a texture, else None."""
    return painted(name) if config.get("texture") else None


def _objects(config: Mapping[str, Any], top: float) -> tuple[Thing, ...]:
    """Return the box, the cylinder and the ball on the table."""
    box, cylinder, ball = (config[f"object{i}"] for i in (1, 2, 3))
    edge, across, diameter = 2 * box["half_size"], 2 * cylinder["radius"], 2 * ball["radius"]
    shapes = (
        ("box", "box", (edge, edge, edge), box),
        ("cylinder", "cylinder", (across, across, cylinder["height"]), cylinder),
        ("ball", "sphere", (diameter, diameter, diameter), ball),
    )
    things = []
    for i, (name, shape, size, table) in enumerate(shapes, 1):
        colour = _paint(config, name) or (float(table["grey"]),) * 3
        place = sum(table["x"]) / 2, -sum(table["y"]) / 2, top + size[2] / 2
        things.append(Thing(name, shape, size, colour, place, (f"object{i}_x", f"object{i}_y")))
    return tuple(things)


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
    """Return the product of two quaternions: rotate by the second, then by the first."""
    (a, b, c, w), (x, y, z, v) = first, second
    return (
        w * x + a * v + b * z - c * y,
        w * y - a * z + b * v + c * x,
        w * z + a * y - b * x + c * v,
        w * v - a * x - b * y - c * z,
    )


def inverse(turn: Quaternion) -> Quaternion:
    """Return the inverse of a unit quaternion."""
    x, y, z, w = turn
    return -x, -y, -z, w


def turned(turn: Quaternion, vector: Sequence[float]) -> NDArray[np.float64]:
    """Rotate a vector by a unit quaternion, (3,)."""
    axis, straight = np.array(turn[:3]), np.array(vector, dtype=np.float64)
    across = 2 * np.cross(axis, straight)
    return np.asarray(straight + turn[3] * across + np.cross(axis, across))
