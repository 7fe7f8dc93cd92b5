"""The messages of a recording, as protobuf: encoders, schemas and their byte layout.

Images are `foxglove.RawImage`, and a scene's cameras, frames and objects Foxglove's messages, too,
so that Foxglove and Rerun show them without us. What a vectorised reader takes out of a message
stands at a fixed distance from its end, because only the timestamp in front of it varies in length.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from foxglove_schemas_protobuf import (
    CameraCalibration_pb2,
    FrameTransforms_pb2,
    PoseInFrame_pb2,
    RawImage_pb2,
    SceneUpdate_pb2,
)
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2

from cdmisfa.core.arrays import ByteArray, FloatArray
from cdmisfa.core.errors import UsageError
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

RECORDING_METADATA = "cdmisfa.recording"
"""Name of the metadata record that says what a recording is."""

SCHEMA_VERSION = 1
"""Rises whenever a channel, a message or a metadata key changes its meaning."""

TRUTH_TOPIC = "/truth"
POSE_TOPIC = "/head_pose"
TRANSFORMS_TOPIC = "/tf"
OBJECTS_TOPIC = "/scene"

SIDES = ("left_eye", "right_eye")

ENCODING = "protobuf"
"""Message and schema encoding of every channel."""

IMAGE_ENCODING = "mono8"
"""Pixel format of image views: one byte of grey."""
IMAGE_SCHEMA = "foxglove.RawImage"
VECTOR_SCHEMA = "cdmisfa.Vector"
TRUTH_SCHEMA = "cdmisfa.GroundTruth"

MAX_TRUTH = 1000
"""Most columns of ground truth: their tags then take at most two bytes."""

_FIRST_TRUTH_FIELD = 2
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,63}")
_FIELD = descriptor_pb2.FieldDescriptorProto


def view_topic(view: str) -> str:
    """Topic of a view's frames."""
    return f"/view/{view}"


def calibration_topic(view: str, side: str) -> str:
    """Topic of the calibration of an eye of a view."""
    return f"/calibration/{view}/{side}"


@dataclass(frozen=True, slots=True)
class Payload:
    """Where a message holds its values, counted from its end.

    Attributes:
        tail: bytes between the values' end and the message's end.
        size: bytes of the values.
        before: bytes that must stand right before the values (tag and length).
    """

    tail: int
    size: int
    before: bytes


def image_payload(height: int, width: int, frame_id: str) -> Payload:
    """Where a `foxglove.RawImage` of grey pixels holds them."""
    name = frame_id.encode()
    size = height * width
    tail = 1 + len(varint(len(name))) + len(name) if name else 0
    return Payload(tail, size, b"\x32" + varint(size))


def vector_payload(length: int) -> Payload:
    """Where a `cdmisfa.Vector` holds its little-endian float64 values."""
    size = 8 * length
    return Payload(0, size, b"\x12" + varint(size) if size else b"")


def truth_tags(names: Sequence[str]) -> list[bytes]:
    """What stands before each of the float64 that end a `cdmisfa.GroundTruth`: its tag."""
    return [varint((_FIRST_TRUTH_FIELD + i) << 3 | 1) for i in range(len(names))]


class _Encoder:
    """Encodes one kind of message, all of which have a timestamp; `schema` is its name."""

    def __init__(self, message: Any) -> None:
        self._message = message
        self.schema: str = message.DESCRIPTOR.full_name

    def schema_data(self) -> bytes:
        """The FileDescriptorSet that describes the message."""
        return descriptor_set(self._message.DESCRIPTOR)

    def _encoded(self, time_ns: int, *stamped: Any) -> bytes:
        """The message at a time, which it holds itself or in its parts."""
        for part in stamped or (self._message,):
            part.timestamp.FromNanoseconds(time_ns)
        return bytes(self._message.SerializeToString())


class ImageEncoder(_Encoder):
    """Frames of a view as `foxglove.RawImage`, mono8.

    Args:
        height: rows of pixels.
        width: pixels of a row.
        frame_id: the coordinate frame the image belongs to.
    """

    def __init__(self, height: int, width: int, frame_id: str) -> None:
        super().__init__(
            RawImage_pb2.RawImage(
                width=width, height=height, step=width, encoding=IMAGE_ENCODING, frame_id=frame_id
            )
        )
        payload = image_payload(height, width, frame_id)
        self._size = payload.size
        self._message.data = bytes(payload.size)
        blank = self._message.SerializeToString()
        end = len(blank) - payload.tail
        # All but its time and its pixels is the same in every message of the view.
        self._around = blank[: end - payload.size], blank[end:]

    def __call__(self, time_ns: int, frame: ByteArray) -> bytes:
        """Encode one frame, (height, width) uint8.

        Raises:
            ValueError: it is of another size.
        """
        before, after = self._around
        if frame.nbytes != self._size:
            raise ValueError(f"a frame of {frame.nbytes} bytes given, not of {self._size}")
        pixels: Any = np.ascontiguousarray(frame)
        return b"".join((_timestamp(time_ns), before, pixels, after))


class VectorEncoder(_Encoder):
    """Values of a stream as `cdmisfa.Vector`, exact to the bit."""

    def __init__(self) -> None:
        repeated = _FIELD.LABEL_REPEATED
        values = _FIELD(name="values", number=2, type=_FIELD.TYPE_DOUBLE, label=repeated)
        super().__init__(_message("Vector", [values]))

    def __call__(self, time_ns: int, frame: FloatArray) -> bytes:
        """Encode one frame, (I,) float64."""
        self._message.values[:] = frame.tolist()
        return self._encoded(time_ns)


class TruthEncoder(_Encoder):
    """What the world knows, as `cdmisfa.GroundTruth`: one double a name.

    Args:
        names: the columns of `Block.truth`.

    Raises:
        UsageError: a name that protobuf does not allow, or too many of them.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = tuple(names)
        if len(names) > MAX_TRUTH or len(set(names)) != len(names):
            raise UsageError(f"ground truth needs at most {MAX_TRUTH} different names")
        for name in names:
            if not _NAME.fullmatch(name) or name == "timestamp":
                raise UsageError(
                    f"ground truth cannot be called {name!r}: use letters, digits and _"
                )
        # Explicit presence: a zero is written too, so that every message has the same layout.
        fields = [
            _FIELD(
                name=name,
                number=_FIRST_TRUTH_FIELD + i,
                type=_FIELD.TYPE_DOUBLE,
                label=_FIELD.LABEL_OPTIONAL,
                proto3_optional=True,
                oneof_index=i,
            )
            for i, name in enumerate(names)
        ]
        super().__init__(_message("GroundTruth", fields))

    def __call__(self, time_ns: int, values: FloatArray) -> bytes:
        """Encode one row of ground truth, (D,) float64."""
        for name, value in zip(self._names, values.tolist(), strict=True):
            setattr(self._message, name, value)
        return self._encoded(time_ns)


class PoseEncoder(_Encoder):
    """A pose in a frame as `foxglove.PoseInFrame`."""

    def __init__(self, frame_id: str) -> None:
        super().__init__(PoseInFrame_pb2.PoseInFrame(frame_id=frame_id))

    def __call__(
        self, time_ns: int, position: Sequence[float], quaternion: Sequence[float]
    ) -> bytes:
        """Encode a position (x, y, z) in metres and an orientation (x, y, z, w)."""
        _set(self._message.pose.position, position)
        _set(self._message.pose.orientation, quaternion)
        return self._encoded(time_ns)


class CalibrationEncoder(_Encoder):
    """How an eye, with its coordinate frame, maps what it sees, as `foxglove.CameraCalibration`."""

    def __init__(self, eye: Eye, frame_id: str) -> None:
        f, x, y = eye.focal, eye.width / 2, eye.height / 2
        super().__init__(
            CameraCalibration_pb2.CameraCalibration(
                frame_id=frame_id,
                width=eye.width,
                height=eye.height,
                K=[f, 0, x, 0, f, y, 0, 0, 1],
                R=[1, 0, 0, 0, 1, 0, 0, 0, 1],
                P=[f, 0, x, 0, 0, f, y, 0, 0, 0, 1, 0],
            )
        )

    def __call__(self, time_ns: int) -> bytes:
        """Encode it at a time."""
        return self._encoded(time_ns)


class TransformsEncoder(_Encoder):
    """Where a view's head and eyes are, as `foxglove.FrameTransforms`.

    From the root's frame to `VIEW/head`, turned by the yaw; from there to VIEW, between the eyes,
    tilted, along whose z they look; and from there to each eye.

    Args:
        gaze: of the view.
        root: name of the root's frame.
    """

    def __init__(self, gaze: Gaze, root: str) -> None:
        super().__init__(FrameTransforms_pb2.FrameTransforms())
        view, head, middle = gaze.name, f"{gaze.name}/head", gaze.middle
        neck, turn = gaze.head.position, gaze.head.quaternion
        self._add(root, head, neck, turn)
        self._add(head, view, *_seen_from(neck, turn, middle))
        for side, eye in zip(SIDES, gaze.eyes, strict=True):
            self._add(view, f"{view}/{side}", *_seen_from(middle.place, middle.turn, eye))

    def __call__(self, time_ns: int) -> bytes:
        """Encode them at a time."""
        return self._encoded(time_ns, *self._message.transforms)

    def _add(self, parent: str, child: str, place: Place, turn: Quaternion) -> None:
        added = self._message.transforms.add(parent_frame_id=parent, child_frame_id=child)
        _set(added.translation, place)
        _set(added.rotation, turn)


class ObjectsEncoder(_Encoder):
    """Where the objects are, and the table, as `foxglove.SceneUpdate`.

    Args:
        scenery: what they look like.
        names: of the columns of truth.
        root: name of the root's frame.
    """

    def __init__(self, scenery: Scenery, names: Sequence[str], root: str) -> None:
        super().__init__(SceneUpdate_pb2.SceneUpdate())
        self._moved = []
        self._add(scenery.table, root)
        for thing in scenery.objects:
            column, row = (list(names).index(name) for name in thing.truth)
            self._moved.append((self._add(thing, root), column, row))

    def __call__(self, time_ns: int, truth: FloatArray) -> bytes:
        """Encode where everything is at a time with this (D,) truth."""
        values = truth.tolist()
        for place, x, y in self._moved:
            place.x, place.y = values[x], -values[y]
        return self._encoded(time_ns, *self._message.entities)

    def _add(self, thing: Thing, root: str) -> Any:
        entity = self._message.entities.add(id=thing.name, frame_id=root)
        shapes = {"box": entity.cubes, "cylinder": entity.cylinders, "sphere": entity.spheres}
        shape = shapes[thing.shape].add()
        if thing.shape == "cylinder":
            shape.bottom_scale = shape.top_scale = 1.0
        _set(shape.size, thing.size)
        shape.color.r, shape.color.g, shape.color.b = thing.colour
        shape.color.a = 1.0
        _set(shape.pose.position, thing.place)
        _set(shape.pose.orientation, (0.0, 0.0, 0.0, 1.0))
        return shape.pose.position


def _set(message: Any, values: Sequence[float]) -> None:
    """Fill in a vector, or a quaternion, (x, y, z, w)."""
    for name, value in zip("xyzw", values, strict=False):
        setattr(message, name, value)


def _seen_from(place: Place, turn: Quaternion, eye: Eye) -> tuple[Place, Quaternion]:
    """Where an eye is, seen from a frame."""
    back = inverse(turn)
    x, y, z = turned(back, np.subtract(eye.place, place).tolist()).tolist()
    return (x, y, z), times(back, eye.turn)


def descriptor_set(descriptor: Any) -> bytes:
    """A message's file and every file it imports, imports first, as MCAP wants it."""
    files: dict[str, descriptor_pb2.FileDescriptorProto] = {}

    def collect(file: Any) -> None:
        for dependency in file.dependencies:
            collect(dependency)
        if file.name not in files:
            files[file.name] = descriptor_pb2.FileDescriptorProto()
            file.CopyToProto(files[file.name])

    collect(descriptor.file)
    collected = descriptor_pb2.FileDescriptorSet(file=files.values())
    return bytes(collected.SerializeToString(deterministic=True))


def _message(name: str, fields: Sequence[Any]) -> Any:
    """An empty message of package cdmisfa: a timestamp as field 1, then the fields."""
    file = descriptor_pb2.FileDescriptorProto(
        name=f"cdmisfa/{name}.proto",
        package="cdmisfa",
        syntax="proto3",
        dependency=[timestamp_pb2.DESCRIPTOR.name],
    )
    message = file.message_type.add(name=name)
    message.field.add(
        name="timestamp",
        number=1,
        type=_FIELD.TYPE_MESSAGE,
        label=_FIELD.LABEL_OPTIONAL,
        type_name=".google.protobuf.Timestamp",
    )
    message.field.extend(fields)
    for field in fields:
        if field.proto3_optional:
            message.oneof_decl.add(name=f"_{field.name}")
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(timestamp_pb2.DESCRIPTOR.serialized_pb)
    pool.AddSerializedFile(file.SerializeToString())
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(f"cdmisfa.{name}"))()


def _timestamp(time_ns: int) -> bytes:
    """A time as field 1 of a message, a `google.protobuf.Timestamp`."""
    seconds, nanos = divmod(time_ns, 1_000_000_000)
    since = b"\x08" + varint(seconds) if seconds else b""
    rest = b"\x10" + varint(nanos) if nanos else b""
    return b"\x0a" + varint(len(since) + len(rest)) + since + rest


@lru_cache(1024)
def varint(number: int) -> bytes:
    """A whole number as protobuf's variable-length integer."""
    out = bytearray()
    while number > 127:
        out.append(number & 127 | 128)
        number >>= 7
    out.append(number)
    return bytes(out)
