"""A log behind a URL: only the parts that are asked for, read ahead where that is known.

Nothing is taken on trust: every part must be of an object that is still the one that was opened.
"""

from __future__ import annotations

import bisect
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
_BUNDLE: Final = 128 * 1024
"""Bytes of expected spans that touch and are asked for together; a longer span is by itself."""
_DEEPEST: Final = 16
"""Bundles that are asked for ahead, at most; and no further one once `_MOST` bytes are."""


class RemoteStore(Store):
    """An object on a server, read part by part; `tag` names its version (ETag or date)."""

    remote = True

    def __init__(self, url: Url) -> None:
        """Look for the object and read its beginning; errors as those of `open_store`."""
        super().__init__(url)
        self._server: Server = connect(url)
        self._parts: deque[tuple[int, bytes]] = deque()
        self._held = 0
        self._bundles: list[tuple[int, int]] = []
        self._ahead: dict[int, Future[Part]] = {}
        self._depth, self._reach, self._follows = 1, _LEAST, -1
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
        number = bisect.bisect_right(self._bundles, (offset, self.size)) - 1
        if number >= 0 and stop <= self._bundles[number][1]:
            start, data = self._expected(number)
        else:
            start, data = self._unexpected(offset, stop)
        self._keep(start, data)
        return data[offset - start : stop - start]

    def expect(self, spans: Sequence[tuple[int, int]]) -> None:
        """Read the spans ahead of what is read of them."""
        self._drop_ahead()
        self._bundles = []
        for start, stop in sorted(spans):
            before = self._bundles[-1] if self._bundles else (0, -1)
            if start == before[1] and stop - before[0] <= _BUNDLE:
                self._bundles[-1] = before[0], stop
            else:
                self._bundles.append((start, stop))

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
        """Fetch a bundle; more and more of those after it are asked for meanwhile."""
        start, stop = self._bundles[number]
        coming = self._ahead.pop(number, None)
        if coming is None:
            self._drop_ahead()
            coming = self._server.begin(start, stop)
        else:
            self._depth = min(2 * self._depth, _DEEPEST)
        asked = sum(high - low for low, high in (self._bundles[n] for n in self._ahead))
        for after in range(number + 1, min(number + 1 + self._depth, len(self._bundles))):
            if after not in self._ahead and asked < _MOST:
                begin, end = self._bundles[after]
                self._ahead[after] = self._server.begin(begin, end)
                asked += end - begin
        return start, self._fetched(coming, start, stop)

    def _drop_ahead(self) -> None:
        for coming in self._ahead.values():
            coming.cancel()
        self._ahead.clear()
        self._depth = 1

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
