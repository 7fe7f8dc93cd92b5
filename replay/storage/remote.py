"""A log behind a URL: only the parts that are asked for, read ahead where that is known.

Nothing is taken on trust: every part must be of an object that is still the one that was opened.
"""

from __future__ import annotations

import bisect
import itertools
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future
from typing import Final

from recorder.mcap.store import Store
from replay.storage.location import Url
from replay.storage.servers import Part, RemoteError, Server, connect

EDGE_BYTES: Final = 64 * 1024
"""What is read of the beginning, and of the end, at once."""
CACHE_BYTES: Final = 16 * 1024 * 1024
"""Bytes of an object that are kept; the last part always is."""
_LEAST: Final = 16 * 1024
_MOST: Final = 1024 * 1024
"""Bytes that are read ahead where reads go forward, at first and at most."""
_AT_ONCE: Final = 16
"""Parts that are asked for ahead, at most; and no further one once `_stride` bytes are."""


class RemoteStore(Store):
    """An object on a server, read part by part; `tag` names its version (ETag or date)."""

    remote = True

    def __init__(self, url: Url) -> None:
        """Look for the object and read its beginning; errors as those of `open_store`."""
        super().__init__(url)
        self._server: Server = connect(url)
        self._parts: deque[tuple[int, bytes]] = deque()
        self._held = 0
        self._spans: list[tuple[int, int]] = []
        self._ahead: dict[tuple[int, int], Future[Part]] = {}
        self._next, self._stride = 0, EDGE_BYTES
        self._reach, self._follows = _LEAST, -1
        first = self._server.wait(self._server.begin(0, EDGE_BYTES), EDGE_BYTES)
        self.size, self.tag = first.total, first.tag
        self._keep(0, self._checked(first, 0, EDGE_BYTES))

    def read_at(self, offset: int, count: int) -> bytes:
        """`count` bytes from `offset` on, fewer only at the end.

        Raises:
            UnreachableError: the server does not give them.
            RemoteError: it gives others, or the object changed.
        """
        stop = min(offset + count, self.size)
        if stop <= offset:
            return b""
        for start, data in reversed(self._parts):
            if start <= offset and stop <= start + len(data):
                return data[offset - start : stop - start]
        number = bisect.bisect_right(self._spans, (offset, self.size)) - 1
        if number >= 0 and stop <= self._spans[number][1]:
            start, data = self._expected(number)
        else:
            start, data = self._unexpected(offset, stop)
        self._keep(start, data)
        return data[offset - start : stop - start]

    def expect(self, spans: Sequence[tuple[int, int]]) -> None:
        """Read the spans ahead of what is read of them."""
        self._drop_ahead()
        self._spans = sorted(spans)

    def forget(self) -> None:
        super().forget()
        self._drop_ahead()
        self._parts.clear()
        self._held = 0

    def close(self) -> None:
        self.forget()

    def _unexpected(self, start: int, stop: int) -> tuple[int, bytes]:
        """Fetch somewhat more than was asked for; more and more while reads go forward."""
        forward = 0 <= start - self._follows <= self._reach
        self._reach = min(2 * self._reach, _MOST) if forward else _LEAST
        if self.size - start <= EDGE_BYTES:
            start = max(self.size - EDGE_BYTES, 0)
        stop = self._follows = min(max(stop, start + self._reach), self.size)
        return start, self._fetched(self._server.begin(start, stop), start, stop)

    def _expected(self, number: int) -> tuple[int, bytes]:
        """Fetch a span that is expected, with more and more of those after it meanwhile."""
        offset = self._spans[number][0]
        part = next((p for p in self._ahead if p[0] <= offset < p[1]), None)
        if part is None:
            self._drop_ahead()
            self._next, self._stride = number, EDGE_BYTES
            part = self._begin_next()
        else:
            self._stride = min(2 * self._stride, _MOST)
        coming = self._ahead.pop(part)
        while (
            self._next < len(self._spans)
            and len(self._ahead) < _AT_ONCE
            and sum(stop - start for start, stop in self._ahead) < self._stride
        ):
            self._begin_next()
        return part[0], self._fetched(coming, *part)

    def _begin_next(self) -> tuple[int, int]:
        """Ask for the next expected span, with those that touch until they are `_stride` bytes."""
        start, stop = self._spans[self._next]
        self._next += 1
        for begin, end in itertools.islice(self._spans, self._next, None):
            if begin != stop or stop - start >= self._stride:
                break
            stop = end
            self._next += 1
        self._ahead[start, stop] = self._server.begin(start, stop)
        return start, stop

    def _drop_ahead(self) -> None:
        for coming in self._ahead.values():
            coming.cancel()
        self._ahead.clear()

    def _fetched(self, coming: Future[Part], start: int, stop: int) -> bytes:
        return self._checked(self._server.wait(coming, stop - start), start, stop)

    def _checked(self, part: Part, start: int, stop: int) -> bytes:
        if (part.total, part.tag) != (self.size, self.tag):
            raise RemoteError(f"{self.path}: it changed while it was read; begin again")
        if len(part.data) != min(stop, self.size) - start:
            raise RemoteError(
                f"{self.path}: the server sent {len(part.data)} bytes of {stop - start} "
                f"at byte {start}"
            )
        return part.data

    def _keep(self, start: int, data: bytes) -> None:
        self._parts.append((start, data))
        self._held += len(data)
        while self._held > CACHE_BYTES and len(self._parts) > 1:
            self._held -= len(self._parts.popleft()[1])
