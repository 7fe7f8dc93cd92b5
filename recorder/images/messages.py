"""Messages of other people that hold images: which they are, and their fields."""

from __future__ import annotations

import base64
import json
import re
import struct
from collections.abc import Callable, Mapping
from functools import partial
from types import SimpleNamespace
from typing import Any, Final, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from cdmisfa.core.arrays import ByteArray
from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import CdmisfaError, one_line
from cdmisfa.core.untrusted import parse_json
from recorder.images.compressed import compressed_image, compressed_words
from recorder.images.fields import Field, field_value, members, numbers_of
from recorder.images.options import Depth, InputOptions
from recorder.images.pixels import DISTANCES, MalformedImage, Shown, raw_image
from recorder.images.videos import Packet, VideoPackets

Decoder = Callable[[bytes | memoryview], Shown]
"""Turns a message into an image or numbers; raises MalformedImage.

One that is `VideoPackets` has to be called with the messages in their order.
"""

_DEPTH_HEADER: Final = struct.Struct("<iff")
"""How compressed_depth_image_transport packed distances, and with which two numbers."""


class Pixels(NamedTuple):
    """What a message with pixels says; see `raw_image`."""

    data: bytes | memoryview
    height: int
    width: int
    encoding: str
    step: int
    big_endian: bool = False

    def image(self, depth: Depth | None, *, color: bool) -> ByteArray:
        """The image that they show; see `raw_image`."""
        return raw_image(*self[:5], big_endian=self.big_endian, depth=depth, color=color)


class Compressed(NamedTuple):
    """What a message with a JPEG or PNG says.

    Attributes:
        data: of the image; of compressed_depth_image_transport, behind a header.
        encoding: of the pixels that were compressed, where ROS says it; else nothing of use.
        packed_depth: whether it is of compressed_depth_image_transport.
    """

    data: bytes
    encoding: str = ""
    packed_depth: bool = False

    def image(self, depth: Depth | None, *, color: bool) -> ByteArray:
        """The image that it shows; see `raw_image`."""
        if self.encoding not in DISTANCES:
            return compressed_image(self.data, color=color)
        head = _DEPTH_HEADER.size if self.packed_depth else 0
        words = compressed_words(self.data[head:])
        distances: NDArray[Any] = words.astype("<u2")
        if self.encoding == "32FC1":  # stored by their inverses, rounded; 0 where none was measured
            _, scale, offset = _DEPTH_HEADER.unpack_from(self.data)
            inverse = words.astype(np.float32) - np.float32(offset)
            with np.errstate(divide="ignore", invalid="ignore"):
                distances = np.where(words > 0, np.float32(scale) / inverse, np.nan).astype("<f4")
        height, width = words.shape
        return raw_image(distances.tobytes(), height, width, self.encoding, depth=depth)


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
    opened = _IMAGES.get((schema, encoding))
    if opened is not None:
        return lambda data: opened(data).image(depth, color=color)
    packet = _VIDEOS.get((schema, encoding))
    return None if packet is None else VideoPackets(packet, color=color)


def stated_format(schema: str, encoding: str, data: bytes | memoryview) -> str:
    """The format of pixels that a message of such a kind states, "" of none; raises MalformedImage.

    Of what is compressed it is that of the pixels before.
    """
    opened = _IMAGES.get((schema, encoding))
    return "" if opened is None else opened(data).encoding


def packed_picture(schema: str, encoding: str, data: bytes | memoryview) -> bytes | None:
    """The JPEG or PNG in a message of a kind in `PACKED`, None of what is packed otherwise."""
    found = _IMAGES[schema, encoding](data)
    plain = isinstance(found, Compressed) and found.encoding not in DISTANCES
    return bytes(found.data) if plain else None


def foxglove_image(schema: str, encoding: str) -> Callable[[bytes], Any] | None:
    """The parser of Foxglove's images in protobuf, which need no definition; None of others."""
    for kind in (RawImage, CompressedImage, CompressedVideo):
        if (schema, encoding) == (kind.DESCRIPTOR.full_name, "protobuf"):
            return partial(_protobuf, kind)
    return None


def ros_stamp(data: bytes | memoryview, *, ros1: bool) -> int:
    """The time in the header that a ROS message begins with, nanoseconds."""
    return _RosFields(data, ros1=ros1).stamp


def _protobuf(kind: Any, data: bytes | memoryview) -> Any:
    try:
        return kind.FromString(data)
    except DecodeError:
        raise MalformedImage(f"a message is no foxglove.{kind.DESCRIPTOR.name}") from None


def _json(_: Any, data: bytes | memoryview) -> Any:
    """The fields of a message of Foxglove in JSON, of which the data are in base64."""
    try:
        fields = json.loads(bytes(data))
    except (ValueError, RecursionError):
        raise MalformedImage("a message is no JSON") from None
    if not isinstance(fields, dict):
        raise MalformedImage("a message is no JSON object")
    try:
        packed = base64.b64decode(fields.get("data", ""), validate=True)
    except (ValueError, TypeError):
        raise MalformedImage("a JSON image's data is no base64") from None
    names = ("height", "width", "step", "encoding", "format")
    return SimpleNamespace(data=packed, **{name: fields.get(name) for name in names})


class _RosFields:
    """Fields of a ROS message after its header, aligned (ROS 2) or packed (ROS 1)."""

    def __init__(self, data: bytes | memoryview, *, ros1: bool) -> None:
        self._data = memoryview(data)
        self.at = 0
        self._ros1 = ros1
        self._order = "<"
        if ros1:
            self.u32()  # its number
        else:
            head = bytes(self.take(4))
            if head[0] != 0 or head[1] not in (0, 1, 6, 7, 8, 9, 10, 11):
                raise MalformedImage("a message is no CDR")
            self._order = "<" if head[1] & 1 else ">"
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


def _foxglove(opened: Callable[[Any, bytes | memoryview], Any], kind: Any) -> Callable[..., Any]:
    """The reader of messages of Foxglove in protobuf, or in JSON."""

    def read(data: bytes | memoryview) -> Pixels | Compressed | Packet:
        m = opened(kind, data)
        if kind is CompressedImage:
            return Compressed(m.data)
        if kind is CompressedVideo:
            return Packet(m.data, str(m.format))
        sizes = (m.height, m.width, m.step)
        if not all(isinstance(n, int) and 0 <= n < 2**32 for n in sizes):
            raise MalformedImage("a JSON image needs whole height, width and step")
        height, width, step = map(int, sizes)
        return Pixels(m.data, height, width, str(m.encoding), step)

    return read


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


def _ros_video(data: bytes | memoryview) -> Packet:
    fields = _RosFields(data, ros1=False)
    return Packet(bytes(fields.data()), fields.text())


def _ffmpeg_packet(data: bytes | memoryview) -> Packet:
    fields = _RosFields(data, ros1=False)
    fields.u32(), fields.u32()  # width and height
    codec = fields.text()
    fields.take(-(fields.at - 4) % 8 + 10)  # a number of 64 bits, and two of 8
    return Packet(bytes(fields.data()), codec)


_IMAGES: Final[Mapping[tuple[str, str], Callable[[bytes | memoryview], Pixels | Compressed]]] = {
    ("foxglove.RawImage", "protobuf"): _foxglove(_protobuf, RawImage),
    ("foxglove.RawImage", "json"): _foxglove(_json, RawImage),
    ("foxglove.CompressedImage", "protobuf"): _foxglove(_protobuf, CompressedImage),
    ("foxglove.CompressedImage", "json"): _foxglove(_json, CompressedImage),
    ("sensor_msgs/msg/Image", "cdr"): partial(_ros_raw, ros1=False),
    ("sensor_msgs/Image", "ros1"): partial(_ros_raw, ros1=True),
    ("sensor_msgs/msg/CompressedImage", "cdr"): partial(_ros_compressed, ros1=False),
    ("sensor_msgs/CompressedImage", "ros1"): partial(_ros_compressed, ros1=True),
}
"""What messages say that hold images, which may be distances."""

PACKED: Final = frozenset(kind for kind in _IMAGES if "Compressed" in kind[0])
"""Kinds of messages that hold a JPEG or PNG, which takes long to decode."""

_VIDEOS: Final[Mapping[tuple[str, str], Callable[[bytes | memoryview], Packet]]] = {
    ("foxglove.CompressedVideo", "protobuf"): _foxglove(_protobuf, CompressedVideo),
    ("foxglove.CompressedVideo", "json"): _foxglove(_json, CompressedVideo),
    ("foxglove_msgs/msg/CompressedVideo", "cdr"): _ros_video,
    ("ffmpeg_image_transport_msgs/msg/FFMPEGPacket", "cdr"): _ffmpeg_packet,
}
"""What messages say that hold a picture of a video."""

SCHEMAS: Final = tuple(sorted({schema for schema, _ in (*_IMAGES, *_VIDEOS)}))
"""Message types that are read."""

Opened = Callable[[bytes], Any]
"""Turns a message into what has its fields; raises MalformedImage."""

Stamp = Callable[[bytes | memoryview], int]
"""Gives a message's own time in nanoseconds; raises MalformedImage."""

_SECONDS: Final = ("sec", "secs", "seconds")
_REST: Final = ("nsec", "nsecs", "nanosec", "nanos")
_HEADER: Final = re.compile(r"(?:std_msgs/)?(?:msg/)?Header\s+\w+")


class MessageKind(NamedTuple):
    """The type and the encoding of a channel's messages.

    Attributes:
        schema: the name of their type.
        encoding: how they are encoded: "protobuf", "json", "cdr", "ros1".
        definition: of the type, as the channel states it.
        language: of the definition: "protobuf", "ros2msg", "ros2idl", "ros1msg".
    """

    schema: str
    encoding: str
    definition: bytes = b""
    language: str = ""


def decoder_of(kind: MessageKind, reading: InputOptions) -> Decoder | None:
    """The decoder of a kind of messages, of images or of fields; None where they hold none.

    Args:
        kind: of the messages.
        reading: what is taken.

    Returns:
        Gives an image, or numbers (I,) float64; raises MalformedImage, and UsageError where
        messages have no such field.
    """
    if not reading.fields:
        return image_decoder(kind.schema, kind.encoding, reading.range, color=reading.color is True)
    opened = message_decoder(kind)
    if opened is None:
        return None
    fields = [Field(path) for path in reading.fields]
    return lambda data: numbers_of(fields, opened(bytes(data)), reading.range)


def message_decoder(kind: MessageKind) -> Opened | None:
    """The decoder of whole messages; None where their encoding or definition is not known."""
    if kind.encoding == "json":
        return _json_message
    if kind.encoding == "protobuf":
        return _protobuf_message(kind)
    return _Ros(kind) if kind.encoding in ("cdr", "ros1") else None


def _json_message(data: bytes) -> Any:
    try:
        return parse_json(data)
    except ValueError as error:
        raise MalformedImage(f"a message is no JSON that is read ({one_line(error)})") from None


def _protobuf_message(kind: MessageKind) -> Opened | None:
    try:
        files = descriptor_pb2.FileDescriptorSet.FromString(kind.definition)
        pool = descriptor_pool.DescriptorPool()
        for file in files.file:
            pool.Add(file)
        parsed = message_factory.GetMessageClass(pool.FindMessageTypeByName(kind.schema))
    except Exception:  # whatever protobuf raises about a definition
        return None

    def opened(data: bytes) -> Any:
        try:
            return parsed.FromString(data)
        except Exception:
            raise MalformedImage(f"a message is no {kind.schema}") from None

    return opened


class _Ros:
    """Messages of ROS 1 or 2, through rosbags, which is needed from the first on."""

    def __init__(self, kind: MessageKind) -> None:
        self._kind = kind
        self._decode: Callable[[bytes, str], Any] | None = None
        package, _, rest = kind.schema.partition("/")
        # ROS 1's sensor_msgs/JointState is sensor_msgs/msg/JointState in ROS 2.
        self._name = kind.schema if "/" in rest or not rest else f"{package}/msg/{rest}"

    def __call__(self, data: bytes) -> Any:
        decode = self._decode = self._decode or self._decoder()
        try:
            return decode(data, self._name)
        except Exception as error:  # whatever rosbags raises
            raise MalformedImage(f"a message is no {self._name} ({one_line(error)})") from None

    def _decoder(self) -> Callable[[bytes, str], Any]:
        """The decoder by the definition; by that of ROS where a log states none."""
        kind = self._kind
        try:
            from rosbags import typesys as ros
        except ImportError:
            raise CdmisfaError(
                f"fields of {kind.schema} need rosbags: pip install rosbags (the extra [ros])"
            ) from None
        ros1 = kind.encoding == "ros1"
        text = kind.definition.decode("utf-8", "replace")
        try:
            if not text.strip():
                store = ros.get_typestore(ros.Stores.ROS1_NOETIC if ros1 else ros.Stores.LATEST)
            else:
                store = ros.get_typestore(ros.Stores.EMPTY)
                idl = kind.language == "ros2idl"
                store.register(
                    ros.get_types_from_idl(text)
                    if idl
                    else ros.get_types_from_msg(text, self._name)
                )
        except Exception as error:  # whatever rosbags raises
            raise MalformedImage(
                f"the definition of {kind.schema} is not read ({one_line(error)})"
            ) from None
        return store.deserialize_ros1 if ros1 else store.deserialize_cdr


def stamp_of(kind: MessageKind) -> Stamp | None:
    """The reader of the times in messages of a kind; None where they hold none."""
    if kind.encoding in ("cdr", "ros1"):
        ros1 = kind.encoding == "ros1"
        lines = kind.definition.decode("utf-8", "replace").splitlines()
        stated = (line.partition("#")[0].strip() for line in lines)
        first = next(filter(None, stated), "")
        has_header = kind.schema in SCHEMAS or _HEADER.fullmatch(first) is not None
        return (lambda data: ros_stamp(data, ros1=ros1)) if has_header else None
    opened = foxglove_image(kind.schema, kind.encoding) or message_decoder(kind)
    return None if opened is None else lambda data: _stamp(opened(bytes(data)))


def _stamp(message: Any) -> int:
    for path in (("header", "stamp"), ("timestamp",), ("stamp",)):
        found = message
        for name in path:
            found = _member(found, name)
        seconds, rest = _member(found, *_SECONDS), _member(found, *_REST, default=0)
        if isinstance(seconds, int) and isinstance(rest, int):
            return seconds * NANOSECONDS + rest
    raise MalformedImage("a message has no time of its own, as header.stamp or timestamp")


def _member(message: Any, *names: str, default: Any = None) -> Any:
    """The first of some fields that a message has."""
    there = members(message)
    return next((field_value(message, name) for name in names if name in there), default)
