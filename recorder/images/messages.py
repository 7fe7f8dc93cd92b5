"""Messages of other people that hold images: which they are, and their fields."""

from __future__ import annotations

import base64
import binascii
import json
import struct
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from cdmisfa.core.clock import NANOSECONDS
from recorder.images.pixels import (
    DISTANCES,
    Bytes,
    MalformedImage,
    compressed_image,
    compressed_words,
    raw_image,
)
from recorder.images.reading import Depth
from recorder.images.videos import Packet, VideoPackets

Decoder = Callable[[bytes | memoryview], Bytes]
"""Turns a message into a gray image, (height, width) uint8; raises MalformedImage.

One that is `VideoPackets` has to be called with the messages in their order.
"""


class Pixels(NamedTuple):
    """What a message with pixels says; see `raw_image`."""

    data: bytes | memoryview
    height: int
    width: int
    encoding: str
    step: int
    big_endian: bool = False


class Compressed(NamedTuple):
    """What a message with a JPEG or PNG says.

    Attributes:
        data: of the image; of compressed_depth_image_transport, behind a header.
        encoding: of the pixels that were compressed, where ROS says it; else nothing of use.
        depth: whether it is of compressed_depth_image_transport.
    """

    data: bytes
    encoding: str = ""
    depth: bool = False


def image_decoder(
    schema: str, encoding: str, depth: Depth | None = None, *, color: bool = False
) -> Decoder | None:
    """The decoder for messages of a schema in an encoding, or None.

    Args:
        schema: type of the messages.
        encoding: of the messages.
        depth: how distances are shown; see `raw_image`.
        color: give what has colours as they are; see `raw_image`.
    """
    if (pixels := _RAW.get((schema, encoding))) is not None:
        return lambda data: raw_image(**pixels(data)._asdict(), depth=depth, color=color)
    if (packet := _PACKETS.get((schema, encoding))) is not None:
        return VideoPackets(packet, color=color)
    if (packed := _COMPRESSED.get((schema, encoding))) is not None:
        return lambda data: _unpacked(packed(data), depth, color=color)
    return None


def holds_distances(schema: str, encoding: str, data: bytes | memoryview) -> bool:
    """Whether a message of such a kind holds distances; raises MalformedImage."""
    found = _RAW.get((schema, encoding)) or _COMPRESSED.get((schema, encoding))
    return found is not None and found(data).encoding in DISTANCES


def _foxglove_raw(data: bytes | memoryview) -> Pixels:
    m = _parse(RawImage, data)
    return Pixels(m.data, m.height, m.width, m.encoding, m.step)


def _unpacked(image: Compressed, depth: Depth | None, *, color: bool) -> Bytes:
    """What a compressed image shows; see `raw_image`."""
    if image.encoding not in DISTANCES:
        return compressed_image(image.data, color=color)
    words = compressed_words(image.data[_DEPTH_HEADER.size :] if image.depth else image.data)
    distances: NDArray[Any] = words.astype("<u2")
    if image.encoding == "32FC1":
        distances = _metres(words, image.data).astype("<f4")
    height, width = words.shape
    return raw_image(distances.tobytes(), height, width, image.encoding, depth=depth)


def _metres(words: NDArray[np.uint16], data: bytes) -> NDArray[np.float32]:
    """Distances that were stored by their inverses, rounded; NaN where none was measured.

    Source: compressed_depth_image_transport, whose header holds the two numbers of the rounding.
    """
    _, scale, offset = _DEPTH_HEADER.unpack_from(data)
    inverse = words.astype(np.float32) - np.float32(offset)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(words > 0, np.float32(scale) / inverse, np.float32(np.nan))


def _foxglove_compressed(data: bytes | memoryview) -> Compressed:
    return Compressed(_parse(CompressedImage, data).data)


def _parse(kind: Any, data: bytes | memoryview) -> Any:
    try:
        return kind.FromString(data)
    except DecodeError:
        raise MalformedImage(f"a message is no foxglove.{kind.DESCRIPTOR.name}") from None


def _json_raw(data: bytes | memoryview) -> Pixels:
    fields = _json(data)
    numbers = [fields.get(k) for k in ("height", "width", "step")]
    if not all(isinstance(n, int) and 0 <= n < 2**32 for n in numbers):
        raise MalformedImage("a JSON image needs whole height, width and step")
    height, width, step = (int(n) for n in numbers if n is not None)
    return Pixels(_base64(fields), height, width, str(fields.get("encoding")), step)


def _json_compressed(data: bytes | memoryview) -> Compressed:
    return Compressed(_base64(_json(data)))


def _json(data: bytes | memoryview) -> Mapping[str, Any]:
    try:
        fields = json.loads(bytes(data))
    except (ValueError, RecursionError):
        raise MalformedImage("a message is no JSON") from None
    if not isinstance(fields, dict):
        raise MalformedImage("a message is no JSON object")
    return fields


def _base64(fields: Mapping[str, Any]) -> bytes:
    try:
        return base64.b64decode(fields.get("data", ""), validate=True)
    except (binascii.Error, ValueError, TypeError):
        raise MalformedImage("a JSON image's data is no base64") from None


class _RosFields:
    """Fields of a ROS message after its header, aligned (ROS 2) or packed (ROS 1)."""

    def __init__(self, data: bytes | memoryview, *, ros1: bool) -> None:
        self._data = memoryview(data)
        self.at = 0
        self._ros1 = ros1
        self._order = "<"
        if not ros1:
            head = bytes(self.take(4))
            if head[0] != 0 or head[1] not in (0, 1, 6, 7, 8, 9, 10, 11):
                raise MalformedImage("a message is no CDR")
            self._order = "<" if head[1] & 1 else ">"
        if ros1:
            self.u32()  # its number
        self.stamp = self.u32() * NANOSECONDS + self.u32()
        self.text()

    def take(self, count: int) -> memoryview:
        if count > len(self._data) - self.at:
            raise MalformedImage("a ROS message is cut short or lies about a length")
        self.at += count
        return self._data[self.at - count : self.at]

    def u32(self) -> int:
        if not self._ros1:  # CDR's own header has 4 bytes, too
            self.take(-self.at % 4)
        return int(struct.unpack(self._order + "I", self.take(4))[0])

    def data(self) -> memoryview:
        return self.take(self.u32())

    def text(self) -> str:
        raw = bytes(self.data())
        return str(raw if self._ros1 else raw.removesuffix(b"\0"), "utf-8", "replace")


def ros_stamp(data: bytes | memoryview, *, ros1: bool) -> int:
    """The time in the header that a ROS message begins with, nanoseconds."""
    return _RosFields(data, ros1=ros1).stamp


def foxglove_image(schema: str, encoding: str) -> Callable[[bytes], Any] | None:
    """What opens Foxglove's images, of which logs need not state a definition; None of others."""
    kinds = (RawImage, CompressedImage, CompressedVideo)
    kind = {kind.DESCRIPTOR.full_name: kind for kind in kinds}.get(schema)
    return None if kind is None or encoding != "protobuf" else partial(_parse, kind)


def _ros_raw(data: bytes | memoryview, *, ros1: bool) -> Pixels:
    fields = _RosFields(data, ros1=ros1)
    height, width, encoding = fields.u32(), fields.u32(), fields.text()
    big_endian, step = bool(fields.take(1)[0]), fields.u32()
    return Pixels(fields.data(), height, width, encoding, step, big_endian)


def _ros_compressed(data: bytes | memoryview, *, ros1: bool) -> Compressed:
    fields = _RosFields(data, ros1=ros1)
    encoding, _, how = fields.text().partition(";")
    packed, depth = bytes(fields.data()), "compressedDepth" in how
    if depth and len(packed) <= _DEPTH_HEADER.size:
        raise MalformedImage("a compressed image of distances is cut short")
    if depth and "rvl" in how:
        raise MalformedImage("its distances are packed as rvl, which is not read: png is")
    plain = "32FC1" in encoding and not depth
    return Compressed(packed, "" if plain else encoding.strip(), depth)


def _foxglove_video(data: bytes | memoryview) -> Packet:
    m = _parse(CompressedVideo, data)
    return Packet(m.data, m.format)


def _json_video(data: bytes | memoryview) -> Packet:
    fields = _json(data)
    return Packet(_base64(fields), str(fields.get("format")))


def _ros_video(data: bytes | memoryview) -> Packet:
    fields = _RosFields(data, ros1=False)
    return Packet(bytes(fields.data()), fields.text())


def _ffmpeg_packet(data: bytes | memoryview) -> Packet:
    fields = _RosFields(data, ros1=False)
    fields.u32(), fields.u32()  # width and height
    codec = fields.text()
    fields.take(-(fields.at - 4) % 8 + 10)  # a number of 64 bits, and two of 8
    return Packet(bytes(fields.data()), codec)


_RAW: Final[Mapping[tuple[str, str], Callable[[bytes | memoryview], Pixels]]] = {
    ("foxglove.RawImage", "protobuf"): _foxglove_raw,
    ("foxglove.RawImage", "json"): _json_raw,
    ("sensor_msgs/msg/Image", "cdr"): partial(_ros_raw, ros1=False),
    ("sensor_msgs/Image", "ros1"): partial(_ros_raw, ros1=True),
}
"""What messages say that hold pixels, which may be distances."""

_DEPTH_HEADER: Final = struct.Struct("<iff")
"""How compressed_depth_image_transport packed distances, and with which two numbers."""

_COMPRESSED: Final[Mapping[tuple[str, str], Callable[[bytes | memoryview], Compressed]]] = {
    ("foxglove.CompressedImage", "protobuf"): _foxglove_compressed,
    ("foxglove.CompressedImage", "json"): _json_compressed,
    ("sensor_msgs/msg/CompressedImage", "cdr"): partial(_ros_compressed, ros1=False),
    ("sensor_msgs/CompressedImage", "ros1"): partial(_ros_compressed, ros1=True),
}

_PACKETS: Final[Mapping[tuple[str, str], Callable[[bytes | memoryview], Packet]]] = {
    ("foxglove.CompressedVideo", "protobuf"): _foxglove_video,
    ("foxglove.CompressedVideo", "json"): _json_video,
    ("foxglove_msgs/msg/CompressedVideo", "cdr"): _ros_video,
    ("ffmpeg_image_transport_msgs/msg/FFMPEGPacket", "cdr"): _ffmpeg_packet,
}
"""What messages say that hold a picture of a video."""

SCHEMAS: Final = tuple(sorted({schema for schema, _ in (*_RAW, *_COMPRESSED, *_PACKETS)}))
"""Message types that are read."""
