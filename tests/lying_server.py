"""A server on this machine that answers with any bytes: a function is given each request."""

from __future__ import annotations

import contextlib
import random
import re
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

Lie = Callable[["Exchange"], None]

CRLF = b"\r\n"
PIECE = 1 << 16
SLOW = 0.5
"""Seconds between two bytes of what only trickles."""

FOR_EVER = 600.0
"""Seconds after which even what never ends is left alone."""


@dataclass(slots=True)
class Liar:
    """A server of one object, and how it lies.

    Attributes:
        body: the object.
        other: another object of the same kind, for what is replaced.
        lie: what answers.
        requests: how many came.
        ended: set when the server is gone, so that nothing trickles on.
    """

    body: bytes
    lie: Lie
    other: bytes = b""
    requests: int = 0
    random: random.Random = field(default_factory=lambda: random.Random(0))
    ended: threading.Event = field(default_factory=threading.Event)
    address: str = ""


@dataclass(slots=True)
class Exchange:
    """A request, and the connection that it came on.

    Attributes:
        number: of the request, from 1.
        start: the first byte that was asked for.
        stop: end of what was asked for, within the object.
    """

    liar: Liar
    connection: socket.socket
    path: str
    number: int
    start: int
    stop: int

    def send(self, *parts: bytes) -> None:
        for part in parts:
            for at in range(0, len(part), PIECE):
                self.connection.sendall(part[at : at + PIECE])

    def head(self, status: str, **headers: object) -> bytes:
        """A status line and headers; the connection closes unless they say so."""
        lines = [f"HTTP/1.1 {status}", *(f"{k.replace('_', '-')}: {v}" for k, v in headers.items())]
        return "\r\n".join([*lines, "Connection: close", "", ""]).encode("latin-1")

    def range_of(self, body: bytes | None = None) -> str:
        body = self.liar.body if body is None else body
        return f"bytes {self.start}-{min(self.stop, len(body)) - 1}/{len(body)}"

    def part(self, body: bytes | None = None, **headers: object) -> None:
        """The true answer, about the object or another one, with headers of one's own."""
        body = self.liar.body if body is None else body
        data = body[self.start : self.stop]
        if self.start >= len(body):
            self.send(self.head("416 No", Content_Range=f"bytes */{len(body)}", Content_Length=0))
            return
        said = {"Content_Range": self.range_of(body), "Content_Length": len(data), "ETag": '"1"'}
        told = {name: value for name, value in {**said, **headers}.items() if value is not None}
        self.send(self.head("206 Partial Content", **told), data)

    def refuse(self, status: str, **headers: object) -> None:
        self.send(self.head(status, Content_Length=0, **headers))

    def reset(self) -> None:
        """End the connection as if the machine had lost its power."""
        linger = struct.pack("ii", 1, 0)
        self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
        self.connection.close()

    def trickle(self, data: bytes) -> None:
        for at in range(len(data)):
            if self.liar.ended.wait(SLOW):
                return
            self.connection.sendall(data[at : at + 1])

    def flood(self, data: bytes) -> None:
        """The same bytes again and again."""
        end = time.monotonic() + FOR_EVER
        while not self.liar.ended.is_set() and time.monotonic() < end:
            self.connection.sendall(data)


@contextlib.contextmanager
def lying(body: bytes, lie: Lie, other: bytes = b"", seed: int = 0) -> Iterator[Liar]:
    """A server of an object that lies in one way; its `address` is that of the object."""
    listener = socket.create_server(("127.0.0.1", 0), backlog=64)
    liar = Liar(body, lie, other, random=random.Random(seed))
    liar.address = f"http://127.0.0.1:{listener.getsockname()[1]}/a.mcap"
    thread = threading.Thread(target=_accept, args=(listener, liar), daemon=True)
    thread.start()
    try:
        yield liar
    finally:
        liar.ended.set()
        listener.shutdown(socket.SHUT_RDWR)
        listener.close()
        thread.join()


def _accept(listener: socket.socket, liar: Liar) -> None:
    with contextlib.suppress(OSError):
        while True:
            connection, _ = listener.accept()
            threading.Thread(target=_answer, args=(connection, liar), daemon=True).start()


def _answer(connection: socket.socket, liar: Liar) -> None:
    with contextlib.suppress(OSError), connection:
        connection.settimeout(10)
        asked = b""
        while b"\r\n\r\n" not in asked:
            more = connection.recv(PIECE)
            if not more:
                return
            asked += more
        liar.requests += 1
        path = asked.split(b" ", 2)[1].decode("latin-1")
        found = re.search(rb"(?i)range: bytes=(\d+)-(\d+)", asked)
        start, last = (int(found[1]), int(found[2])) if found else (0, len(liar.body) - 1)
        stop = min(last + 1, len(liar.body))
        liar.lie(Exchange(liar, connection, path, liar.requests, start, stop))
        with contextlib.suppress(OSError):
            connection.shutdown(socket.SHUT_WR)
