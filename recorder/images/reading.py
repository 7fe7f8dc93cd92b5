"""What is taken of other people's messages and files, and of what kind messages are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

from recorder.images.pixels import Depth

Clock = Literal["log", "header"]


@dataclass(frozen=True, slots=True)
class Reading:
    """What is taken of messages and files.

    Attributes:
        depth: what is shown of distances, see `raw_image`, and the range that numbers are kept in.
        fields: the numbers that are taken instead of images; see `Field`.
        stamp: the times of messages: those of the log, or those in their headers.
        color: whether images are taken in their colours; see `raw_image`.
        time: the column of a table's times, with its unit; see `TableNumbers`.
    """

    depth: Depth | None = None
    fields: tuple[str, ...] = ()
    time: str | None = None
    stamp: Clock = "log"
    color: bool = False


IMAGES = Reading()
"""Images, and no numbers."""


class MessageKind(NamedTuple):
    """Of what kind the messages of a channel are.

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
