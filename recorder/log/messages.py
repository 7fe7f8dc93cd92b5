"""Protobuf messages of a recording: encoders, schemas and byte layout.

Images are `foxglove.RawImage`; the cameras, frames and objects of a scene are Foxglove's messages
too, so that Foxglove and Rerun show them without this package. The values of a message have a fixed
distance from its end, because only the timestamp before them varies in length; a vectorised reader
relies on that.
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
from cdmisfa.core.blocks import HeadPose
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

# Name of the metadata record that describes a recording.
RECORDING_METADATA = "cdmisfa.recording"

# Version of the messages. Raise it if a channel, a message or a metadata key changes its meaning.
SCHEMA_VERSION = 1

TRUTH_TOPIC = "/truth"
POSE_TOPIC = "/head_pose"
TRANSFORMS_TOPIC = "/tf"
OBJECTS_TOPIC = "/scene"

SIDES = ("left_eye", "right_eye")

# Message and schema encoding of every channel.
ENCODING = "protobuf"

# Pixel format of image views: one byte of gray.
IMAGE_ENCODING = "mono8"
IMAGE_SCHEMA = "foxglove.RawImage"
VECTOR_SCHEMA = "cdmisfa.Vector"
TRUTH_SCHEMA = "cdmisfa.GroundTruth"

# Largest number of columns of ground truth; the tags of their fields then take at most two bytes.
MAX_TRUTH = 1000

_FIRST_TRUTH_FIELD = 2
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,63}")
_FIELD = descriptor_pb2.FieldDescriptorProto


def view_topic(view: str) -> str:
    """Return the topic of a view's frames."""
    return f"/view/{view}"


def calibration_topic(view: str, side: str) -> str:
    """Return the topic of the calibration of an eye of a view."""
    return f"/calibration/{view}/{side}"


@dataclass(frozen=True, slots=True)
class Payload:
    """Position of a message's values, counted from its end.

    Attributes:
        tail: number of bytes from the end of the values to the end of the message.
        size: number of bytes of the values.
        before: bytes directly before the values (tag and length).
    """

    tail: int
    size: int
    before: bytes


def image_payload(height: int, width: int, frame_id: str) -> Payload:
    """Return the position of the pixels in a gray `foxglove.RawImage`."""
    name = frame_id.encode()
    size = height * width
    tail = 1 + len(varint(len(name))) + len(name) if name else 0
    return Payload(tail, size, b"\x32" + varint(size))


def vector_payload(length: int) -> Payload:
    """Return the position of the little-endian float64 values in a `cdmisfa.Vector`."""
    size = 8 * length
    return Payload(0, size, b"\x12" + varint(size) if size else b"")


def truth_tags(names: Sequence[str]) -> list[bytes]:
    """Return the tags before the float64 values at the end of a `cdmisfa.GroundTruth`."""
    return [varint((_FIRST_TRUTH_FIELD + i) << 3 | 1) for i in range(len(names))]


class Encoder:
    """Encoder of messages of one type; `schema` is the name of the type.

    Args:
        message: the message, complete except for its time.
        stamped: the parts of it that have a timestamp, if it has none itself.
    """

    def __init__(self, message: Any, stamped: Sequence[Any] = ()) -> None:
        self._message = message
        self._stamped = stamped or (message,)
        self.schema: str = message.DESCRIPTOR.full_name

    def schema_data(self) -> bytes:
        """Return the FileDescriptorSet that describes the message."""
        return descriptor_set(self._message.DESCRIPTOR)

    def __call__(self, time_ns: int, values: Any) -> bytes:
        """Encode the message at a time; derived classes set the values of this time."""
        for part in self._stamped:
            part.timestamp.FromNanoseconds(time_ns)
        return bytes(self._message.SerializeToString())


class ImageEncoder(Encoder):
    """Encoder of frames as `foxglove.RawImage`, mono8.

    Args:
        height: height of the image (pixels).
        width: width of the image (pixels).
        frame_id: coordinate frame of the image.
    """

    def __init__(self, height: int, width: int, frame_id: str) -> None:
        payload = image_payload(height, width, frame_id)
        self._size = payload.size
        image = RawImage_pb2.RawImage(width=width, height=height, step=width, frame_id=frame_id)
        image.encoding, image.data = IMAGE_ENCODING, bytes(payload.size)
        super().__init__(image)
        blank = self._message.SerializeToString()
        end = len(blank) - payload.tail
        # Only time and pixels vary between the messages of a view. Joining the constant parts with
        # them avoids a second copy of the pixels, which protobuf would make.
        self._around = blank[: end - payload.size], blank[end:]

    def __call__(self, time_ns: int, values: ByteArray) -> bytes:
        """Encode one frame, (height, width) uint8.

        Raises:
            ValueError: the frame has another size.
        """
        before, after = self._around
        if values.nbytes != self._size:
            raise ValueError(f"the frame has {values.nbytes} bytes, not {self._size}")
        pixels: Any = np.ascontiguousarray(values)
        return b"".join((_timestamp(time_ns), before, pixels, after))


class VectorEncoder(Encoder):
    """Encoder of vectors as `cdmisfa.Vector`, exact to the bit."""

    def __init__(self) -> None:
        repeated = _FIELD.LABEL_REPEATED
        values = _FIELD(name="values", number=2, type=_FIELD.TYPE_DOUBLE, label=repeated)
        super().__init__(_message("Vector", [values]))

    def __call__(self, time_ns: int, values: FloatArray) -> bytes:
        """Encode one frame, (I,) float64."""
        self._message.values[:] = values.tolist()
        return super().__call__(time_ns, values)


class TruthEncoder(Encoder):
    """Encoder of ground truth as `cdmisfa.GroundTruth`, with a double for each name.

    Args:
        names: names of the columns of `Block.truth`.

    Raises:
        UsageError: protobuf does not allow a name, or there are too many names.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = tuple(names)
        allowed = all(_NAME.fullmatch(name) and name != "timestamp" for name in names)
        if not allowed or len(names) > MAX_TRUTH or len(set(names)) != len(names):
            raise UsageError(
                f"names of ground truth are {', '.join(map(repr, names))[:200]}: give at most "
                f"{MAX_TRUTH} distinct names of letters, digits and _"
            )
        # Explicit presence: protobuf then also writes zeros, so that all messages have one layout.
        double: Any = {"type": _FIELD.TYPE_DOUBLE, "label": _FIELD.LABEL_OPTIONAL}
        fields = [
            _FIELD(name=name, number=i + _FIRST_TRUTH_FIELD, oneof_index=i, **double)
            for i, name in enumerate(names)
        ]
        for field in fields:
            field.proto3_optional = True
        super().__init__(_message("GroundTruth", fields))

    def __call__(self, time_ns: int, values: FloatArray) -> bytes:
        """Encode one row of ground truth, (D,) float64."""
        for name, value in zip(self._names, values.tolist(), strict=True):
            setattr(self._message, name, value)
        return super().__call__(time_ns, values)


class ObjectsEncoder(Encoder):
    """Encoder of the positions of objects and table, as `foxglove.SceneUpdate`.

    Args:
        scenery: the objects.
        names: names of the columns of truth.
        root: name of the root's coordinate frame.
    """

    def __init__(self, scenery: Scenery, names: Sequence[str], root: str) -> None:
        update = SceneUpdate_pb2.SceneUpdate()
        _add_thing(update, scenery.table, root)
        self._moved = []
        for thing in scenery.objects:
            column, row = (list(names).index(name) for name in thing.truth)
            self._moved.append((_add_thing(update, thing, root), column, row))
        super().__init__(update, update.entities)

    def __call__(self, time_ns: int, values: FloatArray) -> bytes:
        """Encode the positions for a row of truth, (D,)."""
        truth = values.tolist()
        for place, x, y in self._moved:
            place.x, place.y = truth[x], -truth[y]
        return super().__call__(time_ns, values)


def _add_thing(update: Any, thing: Thing, root: str) -> Any:
    """Add an object to a `foxglove.SceneUpdate`, and return its position in the message."""
    entity = update.entities.add(id=thing.name, frame_id=root)
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


def pose_encoder(frame_id: str, pose: HeadPose) -> Encoder:
    """Return the encoder of a head pose, as `foxglove.PoseInFrame`."""
    message = PoseInFrame_pb2.PoseInFrame(frame_id=frame_id)
    _set(message.pose.position, pose.position)
    _set(message.pose.orientation, pose.quaternion)
    return Encoder(message)


def calibration_encoder(eye: Eye, frame_id: str) -> Encoder:
    """Return the encoder of an eye's camera matrix, as `foxglove.CameraCalibration`."""
    f, x, y = eye.focal, eye.width / 2, eye.height / 2
    return Encoder(
        CameraCalibration_pb2.CameraCalibration(
            frame_id=frame_id,
            width=eye.width,
            height=eye.height,
            K=[f, 0, x, 0, f, y, 0, 0, 1],
            R=[1, 0, 0, 0, 1, 0, 0, 0, 1],
            P=[f, 0, x, 0, 0, f, y, 0, 0, 0, 1, 0],
        )
    )


def transforms_encoder(gaze: Gaze, root: str) -> Encoder:
    """Return the encoder of the coordinate frames of a view, as `foxglove.FrameTransforms`.

    The frames are a chain: from the root to `VIEW/head`, turned by the yaw; to VIEW, tilted,
    between the eyes, with z along their gaze; and to each eye.
    """
    message = FrameTransforms_pb2.FrameTransforms()
    view, head, middle = gaze.name, f"{gaze.name}/head", gaze.middle
    neck, turn = gaze.head.position, gaze.head.quaternion
    transforms = [(root, head, (neck, turn)), (head, view, _seen_from(neck, turn, middle))]
    for side, eye in zip(SIDES, gaze.eyes, strict=True):
        transforms.append((view, f"{view}/{side}", _seen_from(middle.place, middle.turn, eye)))
    for parent, child, (place, turn) in transforms:
        added = message.transforms.add(parent_frame_id=parent, child_frame_id=child)
        _set(added.translation, place)
        _set(added.rotation, turn)
    return Encoder(message, message.transforms)


def _set(message: Any, values: Sequence[float]) -> None:
    """Set a vector, or a quaternion (x, y, z, w)."""
    for name, value in zip("xyzw", values, strict=False):
        setattr(message, name, value)


def _seen_from(place: Place, turn: Quaternion, eye: Eye) -> tuple[Place, Quaternion]:
    """Return position and rotation of an eye relative to a coordinate frame."""
    back = inverse(turn)
    x, y, z = turned(back, np.subtract(eye.place, place).tolist()).tolist()
    return (x, y, z), times(back, eye.turn)


def descriptor_set(descriptor: Any) -> bytes:
    """Return a FileDescriptorSet of a message and its imports, imports first, as MCAP requires."""
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
    """Return an empty message of package cdmisfa: a timestamp as field 1, then the fields."""
    imports = [timestamp_pb2.DESCRIPTOR.name]
    file = descriptor_pb2.FileDescriptorProto(
        name=f"cdmisfa/{name}.proto", package="cdmisfa", syntax="proto3", dependency=imports
    )
    message = file.message_type.add(name=name)
    time = message.field.add(name="timestamp", number=1, type_name=".google.protobuf.Timestamp")
    time.type, time.label = _FIELD.TYPE_MESSAGE, _FIELD.LABEL_OPTIONAL
    message.field.extend(fields)
    for field in fields:
        if field.proto3_optional:
            message.oneof_decl.add(name=f"_{field.name}")
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(timestamp_pb2.DESCRIPTOR.serialized_pb)
    pool.AddSerializedFile(file.SerializeToString())
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(f"cdmisfa.{name}"))()


def _timestamp(time_ns: int) -> bytes:
    """Encode a time as field 1 of a message, a `google.protobuf.Timestamp`."""
    seconds, nanos = divmod(time_ns, 1_000_000_000)
    since = b"\x08" + varint(seconds) if seconds else b""
    rest = b"\x10" + varint(nanos) if nanos else b""
    return b"\x0a" + varint(len(since) + len(rest)) + since + rest


@lru_cache(1024)
def varint(number: int) -> bytes:
    """Return a number as protobuf's variable-length integer."""
    out = bytearray()
    while number > 127:
        out.append(number & 127 | 128)
        number >>= 7
    out.append(number)
    return bytes(out)
