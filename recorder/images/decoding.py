"""Messages of any type, decoded: their images or numbers, and the times in their headers.

Messages are decoded by the definition that their channel states.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, Final, NamedTuple

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import CdmisfaError, one_line
from cdmisfa.core.untrusted import parse_json
from recorder.images.fields import Field, field_value, members, numbers_of
from recorder.images.messages import SCHEMAS, Decoder, foxglove_image, image_decoder, ros_stamp
from recorder.images.options import Reading
from recorder.images.whole import MalformedImage

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


def decoder_of(kind: MessageKind, reading: Reading) -> Decoder | None:
    """The decoder of a kind of messages, of images or of fields; None where they hold none.

    Args:
        kind: of the messages.
        reading: what is taken.

    Returns:
        Gives an image, or numbers (I,) float64; raises MalformedImage, and UsageError where
        messages have no such field.
    """
    if not reading.fields:
        return image_decoder(kind.schema, kind.encoding, reading.depth, color=reading.color)
    opened = message_decoder(kind)
    if opened is None:
        return None
    fields = [Field(path) for path in reading.fields]
    return lambda data: numbers_of(fields, opened(bytes(data)), reading.depth)


def message_decoder(kind: MessageKind) -> Opened | None:
    """The decoder of whole messages; None where their encoding or definition is not known."""
    if kind.encoding == "json":
        return _json
    if kind.encoding == "protobuf":
        return _protobuf(kind)
    return _Ros(kind) if kind.encoding in ("cdr", "ros1") else None


def _json(data: bytes) -> Any:
    try:
        return parse_json(data)
    except ValueError as error:
        raise MalformedImage(f"a message is no JSON that is read ({one_line(error)})") from None


def _protobuf(kind: MessageKind) -> Opened | None:
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
