"""Messages of any type, decoded by the definition that their channel states."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from cdmisfa.core.errors import CdmisfaError, one_line
from cdmisfa.core.untrusted.memory import parse_json
from recorder.images.fields import Field, numbers_of
from recorder.images.messages import image_decoder
from recorder.images.pixels import MalformedImage, Shown
from recorder.images.reading import MessageKind, Reading

Taken = Callable[[bytes | memoryview], Shown]
"""Turns a message into what is taken of it; raises MalformedImage."""

Opened = Callable[[bytes], Any]
"""Turns a message into what has its fields; raises MalformedImage."""


def decoder_of(kind: MessageKind, reading: Reading) -> Taken | None:
    """The decoder for what is taken of messages; None where they hold no such thing.

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
    """What opens messages of a type; None where nobody says how they are encoded."""
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
    """Messages of ROS 1 or 2, through rosbags, which is asked for with the first."""

    def __init__(self, kind: MessageKind) -> None:
        self._kind = kind
        self._store: Any = None

    def __call__(self, data: bytes) -> Any:
        if self._store is None:
            self._store = _types(self._kind)
        ros1, name = self._kind.encoding == "ros1", _full(self._kind.schema)
        store = self._store
        try:
            return (store.deserialize_ros1 if ros1 else store.deserialize_cdr)(data, name)
        except Exception as error:  # whatever rosbags raises
            raise MalformedImage(f"a message is no {name} ({one_line(error)})") from None


def _types(kind: MessageKind) -> Any:
    """The types of a definition; those that ROS brings where a log states none."""
    try:
        from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
    except ImportError:
        raise CdmisfaError(
            f"fields of {kind.schema} need rosbags: pip install rosbags (the extra [ros])"
        ) from None
    ros1 = kind.encoding == "ros1"
    known = Stores.ROS1_NOETIC if ros1 else Stores.LATEST
    text = kind.definition.decode("utf-8", "replace")
    try:
        if not text.strip():
            return get_typestore(known)
        store = get_typestore(Stores.EMPTY)
        idl = kind.language == "ros2idl"
        types = get_types_from_idl(text) if idl else get_types_from_msg(text, _full(kind.schema))
        store.register(types)
        return store
    except Exception as error:  # whatever rosbags raises
        raise MalformedImage(
            f"the definition of {kind.schema} is not read ({one_line(error)})"
        ) from None


def _full(name: str) -> str:
    """A type's name as ROS 2 has it: sensor_msgs/JointState is sensor_msgs/msg/JointState."""
    package, _, rest = name.partition("/")
    return name if "/" in rest or not rest else f"{package}/msg/{rest}"
