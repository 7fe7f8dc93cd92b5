"""Messages of logs and robots: their images or numbers, and the times in their headers.

This module decodes images of ROS and Foxglove. Other messages are decoded by the definition that
their channel states.
"""

from __future__ import annotations

import base64
import re
import struct
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache, partial
from typing import Any, Final, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from numpy.typing import NDArray

from cdmisfa.core.arrays import ByteArray
from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import one_line
from cdmisfa.core.untrusted import parse_json
from recorder.images.compressed import compressed_image, compressed_words
from recorder.images.fields import EVERY, Field, field_value, members, number_paths, numbers_of
from recorder.images.options import Depth, InputOptions
from recorder.images.pixels import DISTANCES, Content, MalformedImage, raw_image
from recorder.images.videos import Packet, VideoPackets

# Bytes of a message.
Data = bytes | memoryview

# Decodes a message to an image or to numbers; raises MalformedImage.
#
# A decoder of class `VideoPackets` must be called with the messages in their order.
Decoder = Callable[[Data], Content]

# Decodes a message to an object with its fields; raises MalformedImage.
MessageDecoder = Callable[[bytes], Any]

# Returns the time in a message's header (ns); raises MalformedImage.
Stamp = Callable[[Data], int]

# Header of compressed_depth_image_transport: the format, and two numbers that scale distances.
_DEPTH_HEADER: Final = struct.Struct("<iff")

# Largest number of commas of an image in JSON, which has about ten: parsed lists take 20 times the
# memory of their text.
_MAX_COMMAS: Final = 1000

_SECONDS: Final = ("sec", "secs", "seconds")
_NANOS: Final = ("nsec", "nsecs", "nanosec", "nanos")
_HEADER: Final = re.compile(r"(?:std_msgs/)?(?:msg/)?Header\s+\w+")


class MessageKind(NamedTuple):
    """Type and encoding of a channel's messages.

    Attributes:
        schema: name of the type.
        encoding: "protobuf", "json", "cdr" or "ros1".
        definition: definition of the type, as the channel states it.
        language: language of the definition: "protobuf", "ros2msg", "ros2idl" or "ros1msg".
    """

    schema: str
    encoding: str
    definition: bytes = b""
    language: str = ""


class Pixels(NamedTuple):
    """Content of a message with raw pixels; see `raw_image`."""

    data: Data
    height: int
    width: int
    encoding: str
    step: int
    big_endian: bool = False

    def image(self, depth: Depth | None, *, color: bool) -> ByteArray:
        """Convert the pixels; see `raw_image`."""
        return raw_image(*self[:5], big_endian=self.big_endian, depth=depth, color=color)


class Compressed(NamedTuple):
    """Content of a message with a JPEG or PNG.

    Attributes:
        data: the image; in messages of compressed_depth_image_transport it follows a header.
        encoding: pixel format before compression, if ROS states it.
        packed_depth: True for a message of compressed_depth_image_transport.
    """

    data: bytes
    encoding: str = ""
    packed_depth: bool = False

    def image(self, depth: Depth | None, *, color: bool) -> ByteArray:
        """Decode the image; see `raw_image`."""
        if self.encoding not in DISTANCES:
            return compressed_image(self.data, color=color)
        words = compressed_words(self.data[_DEPTH_HEADER.size if self.packed_depth else 0 :])
        distances: NDArray[Any] = words.astype("<u2")
        if self.encoding == "32FC1":  # the words are inverse distances; 0 means no measurement
            _, scale, offset = _DEPTH_HEADER.unpack_from(self.data)
            inverse = words.astype(np.float32) - np.float32(offset)
            with np.errstate(divide="ignore", invalid="ignore"):
                distances = np.where(words > 0, np.float32(scale) / inverse, np.nan).astype("<f4")
        height, width = words.shape
        return raw_image(distances.tobytes(), height, width, self.encoding, depth=depth)


class _RosFields:
    """Reader of the fields of a ROS message after its header, aligned (ROS 2) or packed (ROS 1)."""

    def __init__(self, data: Data, *, ros1: bool) -> None:
        self._data = memoryview(data)
        self.at = 0
        self._ros1 = ros1
        self._order = "<"
        if ros1:
            self.u32()  # sequence number
        else:
            head = bytes(self.take(4))
            if head[0] != 0 or head[1] not in (0, 1, 6, 7, 8, 9, 10, 11):
                raise MalformedImage("a message is not CDR")
            self._order = "<" if head[1] & 1 else ">"
        self.stamp = self.u32() * NANOSECONDS + self.u32()
        self.text()  # frame id

    def take(self, count: int) -> memoryview:
        if count > len(self._data) - self.at:
            raise MalformedImage("a ROS message is cut short or states a wrong length")
        self.at += count
        return self._data[self.at - count : self.at]

    def u32(self) -> int:
        if not self._ros1:  # alignment counts from after CDR's own header, which has 4 bytes too
            self.take(-self.at % 4)
        return int(struct.unpack(self._order + "I", self.take(4))[0])

    def data(self) -> memoryview:
        return self.take(self.u32())

    def text(self) -> str:
        raw = bytes(self.data())
        return str(raw if self._ros1 else raw.removesuffix(b"\0"), "utf-8", "replace")


def _ros_raw(data: Data, *, ros1: bool) -> Pixels:
    fields = _RosFields(data, ros1=ros1)
    height, width, encoding = fields.u32(), fields.u32(), fields.text()
    big_endian, step = bool(fields.take(1)[0]), fields.u32()
    return Pixels(fields.data(), height, width, encoding, step, big_endian)


def _ros_compressed(data: Data, *, ros1: bool) -> Compressed:
    fields = _RosFields(data, ros1=ros1)
    encoding, _, transport = fields.text().partition(";")
    packed, depth = bytes(fields.data()), "compressedDepth" in transport
    if depth and len(packed) <= _DEPTH_HEADER.size:
        raise MalformedImage("a compressed image of distances is cut short")
    if depth and "rvl" in transport:
        raise MalformedImage("its distances are packed as rvl, which is not supported: use png")
    plain = "32FC1" in encoding and not depth
    return Compressed(packed, "" if plain else encoding.strip(), depth)


def _ros_video(data: Data) -> Packet:
    fields = _RosFields(data, ros1=False)
    return Packet(bytes(fields.data()), fields.text())


def _ffmpeg_packet(data: Data) -> Packet:
    fields = _RosFields(data, ros1=False)
    fields.u32(), fields.u32()  # width and height
    codec = fields.text()
    fields.take(-(fields.at - 4) % 8 + 10)  # a number of 64 bits, and two of 8
    return Packet(bytes(fields.data()), codec)


# Foxglove's messages with images: their class, and a function that returns their content.
_FOXGLOVE: Final[Mapping[str, tuple[Any, Callable[[Any, bytes], Any]]]] = {
    "foxglove.RawImage": (
        RawImage,
        lambda m, data: Pixels(data, m.height, m.width, m.encoding, m.step),
    ),
    "foxglove.CompressedImage": (CompressedImage, lambda m, data: Compressed(data)),
    "foxglove.CompressedVideo": (CompressedVideo, lambda m, data: Packet(data, m.format)),
}


def _foxglove(schema: str, encoding: str, data: Data) -> Any:
    """Return the content of a Foxglove message in protobuf or JSON."""
    message_class, content = _FOXGLOVE[schema]
    try:
        if encoding == "protobuf":
            message = message_class.FromString(data)
            return content(message, message.data)
        text = bytes(data)
        if text.count(b",") > _MAX_COMMAS:
            raise ValueError("it has too many values")
        stated = parse_json(text, len(text))
        packed = base64.b64decode(stated.pop("data"), validate=True)
        names = set(message_class.DESCRIPTOR.fields_by_name) - {"timestamp"}
        message = message_class(**{name: stated[name] for name in names & stated.keys()})
        return content(message, packed)
    except Exception as error:  # protobuf raises various exceptions for damaged messages
        raise MalformedImage(f"a message is not a {schema} ({one_line(error)})") from None


# Functions that return the pixels, compressed image or packet, by schema and encoding.
_CONTENT: Final[Mapping[tuple[str, str], Callable[[Data], Any]]] = {
    ("sensor_msgs/msg/Image", "cdr"): partial(_ros_raw, ros1=False),
    ("sensor_msgs/Image", "ros1"): partial(_ros_raw, ros1=True),
    ("sensor_msgs/msg/CompressedImage", "cdr"): partial(_ros_compressed, ros1=False),
    ("sensor_msgs/CompressedImage", "ros1"): partial(_ros_compressed, ros1=True),
    ("foxglove_msgs/msg/CompressedVideo", "cdr"): _ros_video,
    ("ffmpeg_image_transport_msgs/msg/FFMPEGPacket", "cdr"): _ffmpeg_packet,
    **{
        (schema, encoding): partial(_foxglove, schema, encoding)
        for schema in _FOXGLOVE
        for encoding in ("protobuf", "json")
    },
}

_VIDEOS: Final = frozenset(
    kind for kind in _CONTENT if kind[0].endswith(("CompressedVideo", "FFMPEGPacket"))
)

# Kinds of messages with a JPEG or PNG, which takes long to decode.
PACKED: Final = frozenset(kind for kind in _CONTENT if kind[0].endswith("CompressedImage"))

# Types of messages with images.
SCHEMAS: Final = tuple(sorted({schema for schema, _ in _CONTENT}))


def decoder_of(
    kind: MessageKind, options: InputOptions, ordered: Callable[[Any], Any] | None = None
) -> Decoder | None:
    """Return the decoder of the images or the fields of messages, or None.

    Args:
        kind: kind of the messages.
        options: the fields to read, or else the range of distances and whether to keep colors.
        ordered: returns a decoded message with the members of its lists in a fixed order.

    Returns:
        A function that returns an image, or numbers (I,) float64. It raises MalformedImage, or
        UsageError if a message has no such field.
    """
    depth, color = options.range, options.color is True
    if options.fields:
        decode = message_decoder(kind)
        if decode is None:
            return None
        every = options.fields == EVERY
        fields = [] if every else [Field(path) for path in options.fields]

        def numbers(data: Data) -> Content:
            message = decode(bytes(data))
            message = ordered(message) if ordered else message
            fields.extend(map(Field, () if fields else number_paths(message)))
            return numbers_of(fields, message, depth)

        return numbers
    content = _CONTENT.get(kind[:2])
    if content is None:
        return None
    if kind[:2] in _VIDEOS:
        return VideoPackets(content, color=color)
    return lambda data: content(data).image(depth, color=color)


def options_for(topic: str, kind: MessageKind, options: InputOptions) -> InputOptions:
    """Return the options for a topic: of chosen ones, those without images are read as numbers."""
    if not options.topics or (kind[:2] not in _CONTENT and topic not in options.topics):
        return options
    fields = () if kind[:2] in _CONTENT else options.fields or EVERY
    return replace(options, fields=fields)


def stated_format(schema: str, encoding: str, data: Data) -> str:
    """Return the pixel format before compression that a message states, or "".

    Raises:
        MalformedImage: the message is damaged.
    """
    if (schema, encoding) not in _CONTENT or (schema, encoding) in _VIDEOS:
        return ""
    return str(_CONTENT[schema, encoding](data).encoding)


def packed_image(schema: str, encoding: str, data: Data) -> bytes | None:
    """Return the JPEG or PNG in a message of a kind in `PACKED`; None for distances."""
    content = _CONTENT[schema, encoding](data)
    return None if content.encoding in DISTANCES else bytes(content.data)


def message_decoder(kind: MessageKind) -> MessageDecoder | None:
    """Return the decoder of whole messages; None if their encoding or definition is unknown."""
    decode: MessageDecoder | None = parse_json if kind.encoding == "json" else None
    if kind.encoding in ("protobuf", "cdr", "ros1"):
        decode = _protobuf(kind) if kind.encoding == "protobuf" else _ros(kind)
    return decode and partial(_opened, kind.schema, decode)


def _opened(schema: str, decode: MessageDecoder, data: bytes) -> Any:
    try:
        return decode(data)
    except ImportError:
        raise
    except Exception as error:  # protobuf and rosbags raise various exceptions for damaged data
        raise MalformedImage(f"a message is not a {schema} ({one_line(error)})") from None


def _protobuf(kind: MessageKind) -> Any:
    if kind.schema in _FOXGLOVE:
        return _FOXGLOVE[kind.schema][0].FromString
    try:
        pool = descriptor_pool.DescriptorPool()
        for file in descriptor_pb2.FileDescriptorSet.FromString(kind.definition).file:
            pool.Add(file)
        stated = pool.FindMessageTypeByName(kind.schema)
        return message_factory.GetMessageClass(stated).FromString
    except Exception:  # protobuf raises various exceptions for damaged definitions
        return None


def _ros(kind: MessageKind) -> MessageDecoder:
    """Return the decoder of ROS 1 or 2 messages; its first call imports rosbags, which is slow."""
    package, _, rest = kind.schema.partition("/")
    # ROS 1's sensor_msgs/JointState is sensor_msgs/msg/JointState in ROS 2.
    name = kind.schema if "/" in rest or not rest else f"{package}/msg/{rest}"

    @cache
    def deserializer() -> Any:
        from rosbags import typesys as ros

        ros1 = kind.encoding == "ros1"
        text = kind.definition.decode("utf-8", "replace")
        if not text.strip():  # without a definition, use ROS's own
            store = ros.get_typestore(ros.Stores.ROS1_NOETIC if ros1 else ros.Stores.LATEST)
        else:
            store = ros.get_typestore(ros.Stores.EMPTY)
            idl = kind.language == "ros2idl"
            types = ros.get_types_from_idl(text) if idl else ros.get_types_from_msg(text, name)
            store.register(types)
        return store.deserialize_ros1 if ros1 else store.deserialize_cdr

    return lambda data: deserializer()(data, name)


def stamp_of(kind: MessageKind) -> Stamp | None:
    """Return the reader of the times in messages of a kind; None if they have no times."""
    if kind.encoding in ("cdr", "ros1"):
        lines = kind.definition.decode("utf-8", "replace").splitlines()
        stated = (line.partition("#")[0].strip() for line in lines)
        first = next(filter(None, stated), "")
        has_header = kind.schema in SCHEMAS or _HEADER.fullmatch(first) is not None
        ros1 = kind.encoding == "ros1"
        return (lambda data: _RosFields(data, ros1=ros1).stamp) if has_header else None
    decode = message_decoder(kind)
    return None if decode is None else lambda data: _stamp(decode(bytes(data)))


def _stamp(message: Any) -> int:
    header = _member(_member(message, "header"), "stamp")
    for value in (header, _member(message, "timestamp"), _member(message, "stamp")):
        seconds, nanos = _member(value, *_SECONDS), _member(value, *_NANOS, default=0)
        if isinstance(seconds, int) and isinstance(nanos, int):
            return seconds * NANOSECONDS + nanos
    raise MalformedImage("a message has no time of its own, such as header.stamp or timestamp")


def _member(message: Any, *names: str, default: Any = None) -> Any:
    """Return the first of the named fields that a message has."""
    known = members(message)
    return next((field_value(message, name) for name in names if name in known), default)
