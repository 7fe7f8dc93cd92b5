"""Images and numbers of a running robot, through the Foxglove WebSocket protocol.

A client with what a camera needs: the server advertises its channels, the client subscribes to one,
and its messages come. foxglove_bridge serves a ROS 2 robot so.
"""

from __future__ import annotations

import base64
import contextlib
import json
import logging
import struct
import time
from collections.abc import Iterator, Mapping
from typing import Any, Final

from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import CdmisfaError, UsageError, one_line
from cdmisfa.core.untrusted import parse_json
from recorder.cameras.live import Steady
from recorder.images.messages import Decoder, MessageKind, decoder_of
from recorder.images.options import IMAGES, RECIPE, InputOptions
from recorder.images.pixels import Shown
from recorder.images.videos import VideoPackets

# Names of the protocol, the newer first.
PROTOCOLS: Final = ("foxglove.sdk.v1", "foxglove.websocket.v1")

_SUBSCRIPTION: Final = 1
_DATA: Final = 1

# Seconds in which the server must answer.
_TIMEOUT: Final = 10.0

# Seconds to wait for a topic that the server does not have yet.
TOPIC_SECONDS: Final = 5.0

# Times to subscribe again: servers name a new channel a moment before they know it.
_TRIES: Final = 5

# Seconds before each of these times.
_AGAIN: Final = 0.2

# Header of a message: opcode, subscription, log time in nanoseconds.
HEADER: Final = struct.Struct("<BIQ")

# Errors in the threads of websockets are raised here, too: it need not log them with a traceback.
logging.getLogger("websockets").addHandler(logging.NullHandler())


class FoxgloveCamera:
    """A topic of images, or of messages with fields, of a server.

    Args:
        host: of the server, with its port.
        topic: its name; "" for the only one of images.
        name: of the stream.
        options: the fields to read, the range of distances, and whether to decode colours.

    Raises:
        UsageError: websockets is missing.
    """

    finite = False
    rate: float | None = None
    recipe = RECIPE

    def __init__(self, host: str, topic: str, name: str, options: InputOptions = IMAGES) -> None:
        self.name, self._options = name, options
        self._server, self._topic = f"ws://{host}", topic.rstrip("/")
        self._where = f"foxglove://{host.rpartition('@')[2]}"
        try:
            import websockets.sync.client as client
        except ImportError:
            raise UsageError(f"{self._where} needs pip install 'cdmisfa[foxglove]'") from None
        self._client = client

    def images(self) -> Iterator[tuple[int, Shown]]:
        """See `Camera`."""
        try:
            connection = self._client.connect(
                self._server,
                subprotocols=PROTOCOLS,  # type: ignore[arg-type]
                compression=None,
                max_size=None,
                open_timeout=_TIMEOUT,
                proxy=None,
            )
        except Exception as error:  # of the network, the address or the protocol
            raise CdmisfaError(f"{self._where} does not answer: {one_line(error)}") from None
        with connection:
            number, decode = self._find(connection)
            wanted = [{"id": _SUBSCRIPTION, "channelId": number}]
            subscribe = json.dumps({"op": "subscribe", "subscriptions": wanted})
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
                        time.sleep(_AGAIN)
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
                    video = None  # a video is shown from its first key frame on
                    yield age, decode(data)

    def describe(self) -> Mapping[str, Any]:
        """Return the server and the topic."""
        return {"camera": f"{self._where}{self._topic}"}

    def _find(self, connection: Any) -> tuple[int, Decoder]:
        """Wait for the topic; return the number of its channel, and the decoder of its messages."""
        channels: dict[str, Mapping[str, Any]] = {}
        decoders: dict[str, Decoder] = {}
        end = time.monotonic() + TOPIC_SECONDS
        while (left := end - time.monotonic()) > 0 and (self._topic or len(decoders) < 2):
            try:
                event = _event(connection.recv(timeout=left))
            except TimeoutError:
                break
            for channel in event["channels"] if event.get("op") == "advertise" else ():
                topic = str(channel["topic"])
                channels[topic] = channel
                if decoder := decoder_of(_kind(channel), self._options):
                    decoders[topic] = decoder
            topic = self._topic or (next(iter(decoders)) if len(decoders) == 1 else "")
            if topic in decoders:
                return int(channels[topic]["id"]), decoders[topic]
            if topic in channels:
                kind = channels[topic].get("schemaName")
                lacks = "no fields" if self._options.fields else "no images: use --field"
                raise CdmisfaError(f"{self._where}{topic} is {kind}, with {lacks}")
        wanted = "messages with fields" if self._options.fields else "images"
        what = f"has no topic {self._topic}" if self._topic else "has not one such topic"
        known = ", ".join(sorted(decoders)) or "nothing"
        remedy = f"; name one as {self._where}/TOPIC" if decoders else ""
        raise CdmisfaError(f"{self._where} {what}: it has {wanted} on {known}{remedy}")


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
    """Return a text message of the server; {} for binary ones."""
    event = parse_json(message) if isinstance(message, str) else {}
    return event if isinstance(event, dict) else {}
