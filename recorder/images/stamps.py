"""When a message was made, as its header says, and not when it was logged."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, Final

from cdmisfa.core.clock import NANOSECONDS
from recorder.images.decoding import message_decoder
from recorder.images.fields import field_value, members
from recorder.images.messages import SCHEMAS, foxglove_image, ros_stamp
from recorder.images.pixels import MalformedImage
from recorder.images.reading import MessageKind

Stamp = Callable[[bytes | memoryview], int]
"""Gives a message's own time in nanoseconds; raises MalformedImage."""

_PLACES: Final = (("header", "stamp"), ("timestamp",), ("stamp",))
_SECONDS: Final = ("sec", "secs", "seconds")
_REST: Final = ("nsec", "nsecs", "nanosec", "nanos")
_HEADER: Final = re.compile(r"(?:std_msgs/)?(?:msg/)?Header\s+\w+")


def stamp_of(kind: MessageKind) -> Stamp | None:
    """What reads the times in messages of a kind; None where they hold none, or nobody knows."""
    if kind.encoding in ("cdr", "ros1"):
        ros1 = kind.encoding == "ros1"
        stated = kind.schema in SCHEMAS or _begins_with_header(kind.definition)
        return (lambda data: ros_stamp(data, ros1=ros1)) if stated else None
    opened = foxglove_image(kind.schema, kind.encoding) or message_decoder(kind)
    return None if opened is None else lambda data: _stamp(opened(bytes(data)))


def _begins_with_header(definition: bytes) -> bool:
    for line in definition.decode("utf-8", "replace").splitlines():
        stated = line.partition("#")[0].strip()
        if stated:
            return _HEADER.fullmatch(stated) is not None
    return False


def _stamp(message: Any) -> int:
    for place in _PLACES:
        found = message
        for name in place:
            found = _member(found, name)
        names = members(found)
        seconds = next((_member(found, name) for name in _SECONDS if name in names), None)
        rest = next((_member(found, name) for name in _REST if name in names), 0)
        if isinstance(seconds, int) and isinstance(rest, int):
            return seconds * NANOSECONDS + rest
    raise MalformedImage("a message has no time of its own, as header.stamp or timestamp")


def _member(message: Any, name: str) -> Any:
    return field_value(message, name) if name in members(message) else None
