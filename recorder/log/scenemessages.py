"""The world of a recording in the ecosystem's own messages: cameras, frames and objects.

Foxglove and Rerun show the scene from them, without us.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from foxglove_schemas_protobuf import CameraCalibration_pb2, FrameTransforms_pb2, SceneUpdate_pb2
from numpy.typing import NDArray

from recorder.log.messages import descriptor_set
from recorder.log.scenery import (
    Eye,
    Gaze,
    Place,
    Quaternion,
    Scenery,
    Thing,
    inverse,
    times,
    turned,
)

TRANSFORMS_TOPIC = "/tf"
OBJECTS_TOPIC = "/scene"

SIDES = ("left_eye", "right_eye")

_UPRIGHT: Quaternion = (0.0, 0.0, 0.0, 1.0)


def calibration_topic(view: str, side: str) -> str:
    """Topic of the calibration of an eye of a view."""
    return f"/calibration/{view}/{side}"


class CalibrationEncoder:
    """How an eye maps what is in front of it, as `foxglove.CameraCalibration`.

    Args:
        eye: which.
        frame_id: its coordinate frame.
    """

    schema = "foxglove.CameraCalibration"

    def __init__(self, eye: Eye, frame_id: str) -> None:
        f, x, y = eye.focal, eye.width / 2, eye.height / 2
        self._message = CameraCalibration_pb2.CameraCalibration(
            frame_id=frame_id,
            width=eye.width,
            height=eye.height,
            K=[f, 0, x, 0, f, y, 0, 0, 1],
            R=np.eye(3).ravel().tolist(),
            P=[f, 0, x, 0, 0, f, y, 0, 0, 0, 1, 0],
        )

    def schema_data(self) -> bytes:
        """The FileDescriptorSet that describes the message."""
        return descriptor_set(self._message.DESCRIPTOR)

    def __call__(self, time_ns: int) -> bytes:
        """Encode it at a time."""
        self._message.timestamp.FromNanoseconds(time_ns)
        return bytes(self._message.SerializeToString())


class TransformsEncoder:
    """Where a view's head and eyes are, as `foxglove.FrameTransforms`.

    From the root's frame to `VIEW/head`, turned by the yaw; from there to VIEW, between the eyes,
    tilted, along whose z they look; and from there to each eye.

    Args:
        gaze: of the view.
        root: name of the root's frame.
    """

    schema = "foxglove.FrameTransforms"

    def __init__(self, gaze: Gaze, root: str) -> None:
        self._message = FrameTransforms_pb2.FrameTransforms()
        view, head = gaze.name, f"{gaze.name}/head"
        neck, turn = gaze.head.position, gaze.head.quaternion
        self._add(root, head, neck, turn)
        self._add(head, view, *_seen_from(neck, turn, gaze.middle))
        for side, eye in zip(SIDES, gaze.eyes, strict=True):
            middle = gaze.middle
            self._add(view, f"{view}/{side}", *_seen_from(middle.place, middle.turn, eye))

    def schema_data(self) -> bytes:
        """The FileDescriptorSet that describes the message."""
        return descriptor_set(self._message.DESCRIPTOR)

    def __call__(self, time_ns: int) -> bytes:
        """Encode them at a time."""
        for transform in self._message.transforms:
            transform.timestamp.FromNanoseconds(time_ns)
        return bytes(self._message.SerializeToString())

    def _add(self, parent: str, child: str, place: Place, turn: Quaternion) -> None:
        added = self._message.transforms.add(parent_frame_id=parent, child_frame_id=child)
        added.translation.x, added.translation.y, added.translation.z = place
        added.rotation.x, added.rotation.y, added.rotation.z, added.rotation.w = turn


class ObjectsEncoder:
    """Where the objects are, and the table, as `foxglove.SceneUpdate`.

    Args:
        scenery: what they look like.
        names: of the columns of truth.
        root: name of the root's frame.
    """

    schema = "foxglove.SceneUpdate"

    def __init__(self, scenery: Scenery, names: Sequence[str], root: str) -> None:
        self._message = SceneUpdate_pb2.SceneUpdate()
        self._moved = []
        self._add(scenery.table, root)
        for thing in scenery.objects:
            column, row = (list(names).index(name) for name in thing.truth)
            self._moved.append((self._add(thing, root), column, row))

    def schema_data(self) -> bytes:
        """The FileDescriptorSet that describes the message."""
        return descriptor_set(self._message.DESCRIPTOR)

    def __call__(self, time_ns: int, truth: NDArray[np.float64]) -> bytes:
        """Encode where everything is at a time with this (D,) truth."""
        values = truth.tolist()
        for place, x, y in self._moved:
            place.x, place.y = values[x], -values[y]
        for entity in self._message.entities:
            entity.timestamp.FromNanoseconds(time_ns)
        return bytes(self._message.SerializeToString())

    def _add(self, thing: Thing, root: str) -> Any:
        entity = self._message.entities.add(id=thing.name, frame_id=root)
        shapes = {"box": entity.cubes, "cylinder": entity.cylinders, "sphere": entity.spheres}
        shape = shapes[thing.shape].add()
        if thing.shape == "cylinder":
            shape.bottom_scale = shape.top_scale = 1.0
        shape.size.x, shape.size.y, shape.size.z = thing.size
        shape.color.r, shape.color.g, shape.color.b = thing.colour
        shape.color.a = 1.0
        place, turn = shape.pose.position, shape.pose.orientation
        place.x, place.y, place.z = thing.place
        turn.x, turn.y, turn.z, turn.w = _UPRIGHT
        return place


def _seen_from(place: Place, turn: Quaternion, eye: Eye) -> tuple[Place, Quaternion]:
    """Where an eye is, seen from a frame."""
    back = inverse(turn)
    x, y, z = turned(back, np.subtract(eye.place, place).tolist()).tolist()
    return (x, y, z), times(back, eye.turn)
