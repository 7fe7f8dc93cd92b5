"""A recording as a Foxglove WebSocket server: other tools see it as a running robot."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.errors import CdmisfaError, UsageError, one_line
from cdmisfa.modules import Module
from recorder.log.messages import ENCODING
from replay.export.applied import Applied, Messages
from replay.playing.feed import SLICE, Playback, Played, Topic, opened_messages, paced

HOST: Final = "127.0.0.1"

PORT: Final = 8765
"""Where Foxglove looks first."""

BACKLOG: Final = 4096
"""Messages that wait for a client that is slow; then the oldest are dropped."""

LAST_SECONDS: Final = 0.5
"""For which clients may take the last messages."""


def play_as_robot(
    paths: Sequence[Path],
    how: Playback,
    *,
    port: int = PORT,
    wait: int = 1,
    say: Callable[[str], None] = lambda line: None,
) -> Played:
    """Serve a recording's messages on this machine when they are due.

    Messages are those of the files, and so are their log times; at another rate than 1 these pass
    as fast as real time does. Logs that are no MCAP files are played frame by frame.

    Args:
        paths: the recording's folder, or files; or camera logs of others.
        how: it is played.
        port: to listen at; 0 for a free one.
        wait: begin once clients have subscribed to so many topics.
        say: told the address.

    Raises:
        UsageError: no such log, or foxglove-sdk is missing.
        LogDamagedError: it is damaged.
        CdmisfaError: the port is taken.
    """
    played = Played()
    with opened_messages(paths, how) as feed, Robot(feed.topics, port) as robot:
        say(f"playing at ws://{HOST}:{robot.port}{', once watched' if wait else ''}")
        while robot.watched < wait and not how.stop():
            time.sleep(SLICE / 10)
        for since, message in paced(feed, how, played):
            robot.publish(message.topic, message.data, feed.start + round(since / how.rate))
            how.progress(played.seconds, feed.seconds(how))
    return played


class Robot:
    """A Foxglove WebSocket server of this machine, with a channel for each topic.

    Args:
        topics: that clients may subscribe to.
        port: to listen at; 0 for a free one.
        name: that clients are told.

    Raises:
        UsageError: foxglove-sdk is missing.
        CdmisfaError: the port is taken.
    """

    def __init__(self, topics: Sequence[Topic], port: int, name: str = "cdmisfa play") -> None:
        try:
            import foxglove
            from foxglove.websocket import ServerListener
        except ImportError:
            raise UsageError(
                "to serve as a robot needs foxglove-sdk: pip install 'cdmisfa[foxglove]'"
            ) from None
        # Else it logs a line about each client that leaves without a word.
        foxglove.set_log_level("CRITICAL")
        subscribed: set[tuple[int, int]] = set()

        class Listener(ServerListener):
            def on_subscribe(self, client: Any, channel: Any) -> None:
                subscribed.add((client.id, channel.id))

            def on_unsubscribe(self, client: Any, channel: Any) -> None:
                subscribed.discard((client.id, channel.id))

        self._subscribed = subscribed
        self._context = context = foxglove.Context()  # holds the channels
        self._channels: dict[Topic, Any] = {}
        for topic in topics:
            schema = foxglove.Schema(
                name=topic.schema_name, encoding=topic.schema_encoding, data=topic.schema
            )
            self._channels[topic] = foxglove.Channel(
                topic.name,
                schema=schema if topic.schema_name else None,
                message_encoding=topic.encoding,
                context=context,
            )
        try:
            self._server = foxglove.start_server(
                name=name,
                host=HOST,
                port=port,
                server_listener=Listener(),
                context=context,
                message_backlog_size=BACKLOG,
            )
        except Exception as error:  # of the network
            raise CdmisfaError(
                f"no robot at port {port}: {one_line(error)}: choose another with --port"
            ) from None

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._server.port)

    @property
    def watched(self) -> int:
        """Subscriptions that there are."""
        return len(self._subscribed)

    def publish(self, topic: Topic, data: bytes, time_ns: int) -> None:
        """Tell a message to who has subscribed to its topic."""
        self._channels[topic].log(data, log_time=time_ns)

    def __enter__(self) -> Robot:
        return self

    def __exit__(self, *error: object) -> None:
        if self._subscribed and not any(error):
            time.sleep(LAST_SECONDS)
        self._server.stop()


class RobotSink:
    """Serves what modules give, and the frames, as a running robot; see `Messages`.

    Args:
        port: to listen at; 0 for a free one.
        spec: of the frames.
        modules: in their order.
    """

    def __init__(self, port: int, spec: SourceSpec, modules: Sequence[Module]) -> None:
        self._messages = Messages(spec, modules)
        self._topics = {
            topic: Topic(topic.name, ENCODING, topic.schema, ENCODING, topic.definition)
            for topic in self._messages.topics
        }
        self._robot = Robot(tuple(self._topics.values()), port, "cdmisfa apply")

    @property
    def port(self) -> int:
        """Where it listens."""
        return self._robot.port

    def add(self, applied: Applied) -> None:
        """See `AppliedSink`."""
        for topic, at, data in self._messages.of(applied):
            self._robot.publish(self._topics[topic], data, at)

    def close(self) -> None:
        """See `AppliedSink`."""
        self._robot.__exit__()
