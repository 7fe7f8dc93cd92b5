"""Images of a running robot, through the Foxglove WebSocket protocol.

A client of what a camera needs of it: the server says which channels there are, one of images is
subscribed to, and its messages come. foxglove_bridge serves a ROS 2 robot so.
"""

from __future__ import annotations

import json
import struct
import time
from collections.abc import Iterator, Mapping
from typing import Any, Final
from urllib.parse import urlsplit

from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import CdmisfaError, UsageError, one_line
from cdmisfa.core.untrusted.memory import parse_json
from recorder.cameras.video import Steady
from recorder.images.messages import Decoder, image_decoder
from recorder.images.pixels import Bytes, Depth

PROTOCOLS: Final = ("foxglove.sdk.v1", "foxglove.websocket.v1")
"""Names of the protocol, the newer first."""

_SUBSCRIPTION: Final = 1
_DATA: Final = 1
_HEADER: Final = struct.Struct("<BIQ")
"""Of a message: what it is, the subscription it is for, and its log time."""


class FoxgloveCamera:
    """A topic of images of a server.

    Args:
        word: foxglove://HOST:PORT/TOPIC; without a topic the only one of images.
        name: of the stream.
        timeout: seconds in which the server must answer and name the topic.
        depth: how distances are shown; see `gray`.

    Raises:
        UsageError: the word is no such address, or websockets is missing.
    """

    finite = False
    rate: float | None = None

    def __init__(self, word: str, name: str, *, timeout: float, depth: Depth | None = None) -> None:
        self.name, self._depth = name, depth
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

    def pictures(self) -> Iterator[tuple[int, Bytes]]:
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
            number, decode = self._find(connection)
            wanted = [{"id": _SUBSCRIPTION, "channelId": number}]
            connection.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
            steady = Steady()
            for message in connection:
                if isinstance(message, bytes) and len(message) >= _HEADER.size:
                    kind, subscription, log_time = _HEADER.unpack_from(message)
                    if (kind, subscription) == (_DATA, _SUBSCRIPTION):
                        logged = log_time / NANOSECONDS if log_time else None
                        age = steady.age(time.monotonic(), logged)
                        yield age, decode(message[_HEADER.size :])
                elif isinstance(message, str) and self._is_gone(message, number):
                    return

    def describe(self) -> Mapping[str, Any]:
        """The server and the topic."""
        return {"camera": f"{self._where}{self._topic}"}

    def _find(self, connection: Any) -> tuple[int, Decoder]:
        """The channel of the topic, waited for, and how its messages are decoded."""
        channels: dict[str, Mapping[str, Any]] = {}
        end = time.monotonic() + self._timeout
        while (left := end - time.monotonic()) > 0:
            try:
                told = _told(connection.recv(timeout=left))
            except TimeoutError:
                break
            if told.get("op") == "advertise":
                channels |= {str(c.get("topic")): c for c in told.get("channels", ())}
            images = {t: d for t, c in channels.items() if (d := self._decoder(c)) is not None}
            found = self._topic or (next(iter(images)) if len(images) == 1 else "")
            if found in images:
                return int(channels[found]["id"]), images[found]
            if found in channels:
                kind = channels[found].get("schemaName")
                raise CdmisfaError(f"{self._where}{found} holds {kind}, which is no image")
        known = ", ".join(sorted(t for t, c in channels.items() if self._decoder(c))) or "nothing"
        what = f"has no topic {self._topic}" if self._topic else "has not one topic of images"
        raise CdmisfaError(f"{self._where} {what}: it has images on {known}")

    def _decoder(self, channel: Mapping[str, Any]) -> Decoder | None:
        schema, encoding = str(channel.get("schemaName")), str(channel.get("encoding"))
        return image_decoder(schema, encoding, self._depth)

    @staticmethod
    def _is_gone(message: str, number: int) -> bool:
        told = _told(message)
        return told.get("op") == "unadvertise" and number in told.get("channelIds", ())


def _told(message: str | bytes) -> Mapping[str, Any]:
    """What a server says in words; nothing where it says it in bytes."""
    try:
        told = parse_json(message) if isinstance(message, str) else {}
    except ValueError:
        told = {}
    return told if isinstance(told, dict) else {}
