"""Images and numbers of a running robot, through the Foxglove WebSocket protocol.

The server advertises channels, the client subscribes to one and receives its messages.
foxglove_bridge serves a ROS 2 robot in this way.
"""

from __future__ import annotations

import base64
import contextlib
import json
import logging
import struct
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, Final

from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import CdmisfaError, needs, one_line
from cdmisfa.core.untrusted import parse_json
from recorder.cameras.live import Steady
from recorder.images.messages import Decoder, MessageKind, decoder_of, options_for
from recorder.images.options import IMAGES, RECIPE, InputOptions
from recorder.images.pixels import Content
from recorder.images.videos import VideoPackets

# Names of the protocol, the newer one first.
PROTOCOLS: Final = ("foxglove.sdk.v1", "foxglove.websocket.v1")

# Number that the client gives to its only subscription.
_SUBSCRIPTION: Final = 1

# Opcode of the binary messages that carry data.
_DATA: Final = 1

# Seconds within which the server must answer.
_TIMEOUT: Final = 10.0

# Seconds to wait for a topic that the server does not have yet.
TOPIC_SECONDS: Final = 5.0

# Number of further attempts to subscribe, and seconds between them: servers advertise a new channel
# a moment before they accept a subscription.
_TRIES: Final = 5
_RETRY_SECONDS: Final = 0.2

# Header of a message: opcode, subscription, log time (ns).
HEADER: Final = struct.Struct("<BIQ")

# This module raises the errors in websockets' threads itself: they need no logged traceback.
logging.getLogger("websockets").addHandler(logging.NullHandler())


class FoxgloveCamera:
    """Camera that reads a topic of a Foxglove server: images, or messages with fields.

    Args:
        host: host of the server, with its port.
        topic: name of the topic; "" for the only one with images.
        name: name of the stream.
        options: the fields to read, the range of distances, and whether to decode colors.

    Raises:
        MissingPackageError: websockets is not installed.
    """

    finite = False
    rate: float | None = None
    recipe = RECIPE

    def __init__(self, host: str, topic: str, name: str, options: InputOptions = IMAGES) -> None:
        self._server, self._topic = f"ws://{host}", topic.rstrip("/")
        topics = (self._topic,) if self._topic else ()
        self.name, self._options = name, replace(options, topics=topics)
        self._public_address = f"foxglove://{host.rpartition('@')[2]}"
        with needs(self._public_address, "websockets", "'cdmisfa[foxglove]'"):
            import websockets.sync.client as client
        self._client = client

    def images(self) -> Iterator[tuple[int, Content]]:
        """Connect, and yield the images of the topic; see `Camera`."""
        try:
            connection = self._client.connect(
                self._server,
                subprotocols=PROTOCOLS,  # type: ignore[arg-type]
                compression=None,
                max_size=None,  # a raw image can exceed the default of 1 MiB
                open_timeout=_TIMEOUT,
                proxy=None,
            )
        except Exception as error:  # various exceptions of network, address and protocol
            raise CdmisfaError(f"{self._public_address}: no answer: {one_line(error)}") from None
        with connection:
            number, decode = self._find(connection)
            subscriptions = [{"id": _SUBSCRIPTION, "channelId": number}]
            subscribe = json.dumps({"op": "subscribe", "subscriptions": subscriptions})
            connection.send(subscribe)
            tries, steady = _TRIES, Steady()
            video = decode if isinstance(decode, VideoPackets) else None
            for message in connection:
                if isinstance(message, str):
                    event = _event(message)
                    if event.get("op") == "unadvertise" and number in event["channelIds"]:
                        return
                    if event.get("op") == "status" and event.get("level") in (1, 2) and tries:
                        tries -= 1
                        time.sleep(_RETRY_SECONDS)
                        connection.send(subscribe)
                    continue
                if len(message) < HEADER.size:
                    continue
                opcode, subscription, log_time = HEADER.unpack_from(message)
                if (opcode, subscription) != (_DATA, _SUBSCRIPTION):
                    continue
                tries = 0
                age = steady.age(time.monotonic(), log_time / NANOSECONDS if log_time else None)
                data = message[HEADER.size :]
                if video is None or video.begins(data):
                    video = None  # a video begins with its first key frame
                    yield age, decode(data)

    def describe(self) -> Mapping[str, Any]:
        """Return the server and the topic."""
        return {"camera": f"{self._public_address}{self._topic}"}

    def _find(self, connection: Any) -> tuple[int, Decoder]:
        """Wait for the topic; return the id of its channel, and the decoder of its messages."""
        channels: dict[str, Mapping[str, Any]] = {}
        decoders: dict[str, Decoder] = {}
        end = time.monotonic() + TOPIC_SECONDS
        while (rest := end - time.monotonic()) > 0 and (self._topic or len(decoders) < 2):
            try:
                event = _event(connection.recv(timeout=rest))
            except TimeoutError:
                break
            for channel in event["channels"] if event.get("op") == "advertise" else ():
                topic = str(channel["topic"])
                channels[topic] = channel
                messages = _kind(channel)
                if decoder := decoder_of(messages, options_for(topic, messages, self._options)):
                    decoders[topic] = decoder
            topic = self._topic or (next(iter(decoders)) if len(decoders) == 1 else "")
            if topic in decoders:
                return int(channels[topic]["id"]), decoders[topic]
            if topic in channels:
                kind = channels[topic].get("schemaName")
                lacks = "neither images nor known fields"
                raise CdmisfaError(f"{self._public_address}{topic} is {kind}, with {lacks}")
        content = "messages with fields" if self._options.fields else "images"
        problem = f"has no topic {self._topic}" if self._topic else "does not have one such topic"
        known = ", ".join(sorted(decoders)) or "nothing"
        remedy = f": name one as {self._public_address}/TOPIC" if decoders else ""
        raise CdmisfaError(f"{self._public_address} {problem}: it has {content} on {known}{remedy}")


def _kind(channel: Mapping[str, Any]) -> MessageKind:
    """Return the kind of a channel's messages, as the server states it."""
    definition = str(channel.get("schema", "")).encode()
    encoding = str(channel.get("encoding"))
    if encoding == "protobuf":  # its definition is binary
        with contextlib.suppress(ValueError):
            definition = base64.b64decode(definition, validate=True)
    language = str(channel.get("schemaEncoding", ""))
    return MessageKind(str(channel.get("schemaName")), encoding, definition, language)


def _event(message: str | bytes) -> Mapping[str, Any]:
    """Return a text message of the server as a mapping; {} for a binary message."""
    event = parse_json(message) if isinstance(message, str) else {}
    return event if isinstance(event, dict) else {}
