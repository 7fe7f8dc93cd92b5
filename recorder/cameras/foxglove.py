"""Images and numbers of a running robot, through the Foxglove WebSocket protocol.

A client of what a camera needs of it: the server says which channels there are, one is subscribed
to, and its messages come. foxglove_bridge serves a ROS 2 robot so.
"""

from __future__ import annotations

import base64
import contextlib
import json
import logging
import struct
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final
from urllib.parse import urlsplit

from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import CdmisfaError, UsageError, one_line
from cdmisfa.core.untrusted import parse_json
from recorder.cameras.video import Steady
from recorder.images.messages import Decoder, MessageKind, decoder_of, stated_format
from recorder.images.options import IMAGES, InputOptions
from recorder.images.pixels import DISTANCES, Shown
from recorder.images.videos import VideoPackets

PROTOCOLS: Final = ("foxglove.sdk.v1", "foxglove.websocket.v1")
"""Names of the protocol, the newer first."""

_SUBSCRIPTION: Final = 1
_DATA: Final = 1
TOPIC_SECONDS: Final = 5.0
"""Seconds to wait for a topic that the server does not have yet."""

_QUIET: Final = 0.5
"""Seconds without a further topic after which the server is taken to have named those it has."""

_TRIES: Final = 5
"""Times to subscribe again: servers name a new channel a moment before they know it."""

_AGAIN: Final = 0.2
"""Seconds before each."""

HEADER: Final = struct.Struct("<BIQ")
"""Header of a message: opcode, subscription, log time in nanoseconds."""

# Errors of its threads are raised here, too: it need not log them with a traceback.
logging.getLogger("websockets").addHandler(logging.NullHandler())


class FoxgloveCamera:
    """A topic of images, or of messages with fields, of a server.

    Args:
        word: foxglove://HOST:PORT/TOPIC; without a topic the only one of images.
        name: of the stream.
        timeout: seconds in which the server must answer.
        reading: what is taken of messages.
        say: told in a line what is waited for, and what does not apply.

    Raises:
        UsageError: the word is no such address, or websockets is missing.
    """

    finite = False
    rate: float | None = None
    distances: bool | None = None
    """Whether its first image holds distances; None before that, and of numbers."""

    def __init__(
        self,
        word: str,
        name: str,
        *,
        timeout: float,
        reading: InputOptions = IMAGES,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        self.name, self._reading, self._say = name, reading, say
        place = urlsplit(word)
        if not place.netloc:
            raise UsageError(f"{word} names no server: write foxglove://HOST:8765/TOPIC")
        self._server = f"ws://{place.netloc}"
        self._topic = place.path.rstrip("/")
        self._where = f"foxglove://{place.netloc.rpartition('@')[2]}"
        self._timeout = timeout
        try:
            import websockets.sync.client as client
        except ImportError:
            raise UsageError(
                f"{self._where} needs websockets: pip install 'cdmisfa[foxglove]'"
            ) from None
        self._client = client

    def pictures(self) -> Iterator[tuple[int, Shown]]:
        """See `Camera`."""
        try:
            connection = self._client.connect(
                self._server,
                subprotocols=PROTOCOLS,  # type: ignore[arg-type]
                compression=None,
                max_size=None,
                open_timeout=self._timeout,
                proxy=None,
            )
        except Exception as error:  # of the network, the address or the protocol
            raise CdmisfaError(f"{self._where} does not answer: {one_line(error)}") from None
        with connection:
            number, kind, decode = self._find(connection)
            wanted = [{"id": _SUBSCRIPTION, "channelId": number}]
            subscribe = json.dumps({"op": "subscribe", "subscriptions": wanted})
            connection.send(subscribe)
            tries = _TRIES
            steady = Steady()
            video = decode if isinstance(decode, VideoPackets) else None
            for message in connection:
                told = _told(message)
                if told.get("op") == "unadvertise" and number in told.get("channelIds", ()):
                    return
                if told.get("op") == "status" and told.get("level") in (1, 2) and tries:
                    tries -= 1
                    time.sleep(_AGAIN)
                    connection.send(subscribe)
                if not isinstance(message, bytes) or len(message) < HEADER.size:
                    continue
                what, subscription, log_time = HEADER.unpack_from(message)
                if (what, subscription) != (_DATA, _SUBSCRIPTION):
                    continue
                tries = 0
                age = steady.age(time.monotonic(), log_time / NANOSECONDS if log_time else None)
                data = message[HEADER.size :]
                if self.distances is None and not self._reading.fields:
                    stated = stated_format(kind.schema, kind.encoding, data)
                    self.distances = stated in DISTANCES
                if video is None or video.begins(data):
                    video = None  # from its first whole picture on all are shown
                    yield age, decode(data)

    def describe(self) -> Mapping[str, Any]:
        """The server and the topic."""
        return {"camera": f"{self._where}{self._topic}"}

    def _find(self, connection: Any) -> tuple[int, MessageKind, Decoder]:
        """The channel of the topic, waited for, of what kind it is, and its decoder."""
        channels: dict[str, Mapping[str, Any]] = {}
        images: dict[str, Decoder] = {}
        said = False
        end = time.monotonic() + TOPIC_SECONDS
        while (left := end - time.monotonic()) > 0:
            try:
                told = _told(connection.recv(timeout=left if said else min(left, _QUIET)))
            except TimeoutError:
                if images and not self._topic:
                    break  # there are several already, and one topic was looked for
                if not said:
                    self._say(f"{self._lacking(images)}; waiting {left:.0f} s for it")
                said = True
                continue
            if told.get("op") == "advertise":
                channels |= {str(c.get("topic")): c for c in told.get("channels", ())}
                decoders = {t: decoder_of(_kind(c), self._reading) for t, c in channels.items()}
                images = {topic: decode for topic, decode in decoders.items() if decode is not None}
            found = self._topic or (next(iter(images)) if len(images) == 1 else "")
            if found in images:
                channel = channels[found]
                return int(channel["id"]), _kind(channel), images[found]
            if found in channels:
                kind = channels[found].get("schemaName")
                lacks = "is no image: its numbers are taken with --field"
                if self._reading.fields:
                    lacks = "has no fields"
                raise CdmisfaError(f"{self._where}{found} holds {kind}, which {lacks}")
        remedy = f"; name one as {self._where}/TOPIC" if images else ""
        raise CdmisfaError(f"{self._lacking(images)}{remedy}")

    def _lacking(self, images: Mapping[str, Decoder]) -> str:
        """Message for a missing topic, with what the server has instead."""
        wanted = "messages with fields" if self._reading.fields else "images"
        known = ", ".join(sorted(images)) or "nothing"
        what = f"has no topic {self._topic}" if self._topic else "has not one such topic"
        return f"{self._where} {what}: it has {wanted} on {known}"


def _kind(channel: Mapping[str, Any]) -> MessageKind:
    """The kind of a channel's messages, as the server states it."""
    schema, language = channel.get("schema"), str(channel.get("schemaEncoding", ""))
    definition = schema.encode() if isinstance(schema, str) else b""
    encoding = str(channel.get("encoding"))
    if encoding == "protobuf":  # its definition is no text
        with contextlib.suppress(ValueError):
            definition = base64.b64decode(definition, validate=True)
    return MessageKind(str(channel.get("schemaName")), encoding, definition, language)


def _told(message: str | bytes) -> Mapping[str, Any]:
    """A text message of the server as JSON; {} for binary ones."""
    try:
        told = parse_json(message) if isinstance(message, str) else {}
    except ValueError:
        told = {}
    return told if isinstance(told, dict) else {}
