"""The messages of a recording, as protobuf: encoders, schemas and their byte layout.

Images are `foxglove.RawImage`, so Foxglove and Rerun show them without us. What a
vectorised reader takes out of a message stands at a fixed distance from its end,
because only the timestamp in front of it varies in length.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from foxglove_schemas_protobuf import PoseInFrame_pb2, RawImage_pb2
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from numpy.typing import NDArray

from cdmisfa.core.errors import UsageError

RECORDING_METADATA = "cdmisfa.recording"
"""Name of the metadata record that says what a recording is."""

SCHEMA_VERSION = 1
"""Rises whenever a channel, a message or a metadata key changes its meaning."""

TRUTH_TOPIC = "/truth"
POSE_TOPIC = "/head_pose"

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

    def _encoded(self, time_ns: int) -> bytes:
        self._message.timestamp.FromNanoseconds(time_ns)
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

    def __call__(self, time_ns: int, frame: NDArray[np.uint8]) -> bytes:
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

    def __call__(self, time_ns: int, frame: NDArray[np.float64]) -> bytes:
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

    def __call__(self, time_ns: int, values: NDArray[np.float64]) -> bytes:
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
        place, turn = self._message.pose.position, self._message.pose.orientation
        place.x, place.y, place.z = position
        turn.x, turn.y, turn.z, turn.w = quaternion
        return self._encoded(time_ns)


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
