"""A log behind a URL: only the parts that are asked for, read ahead where that is known.

Nothing is taken on trust: every part must be of an object that is still the one that was opened.
"""

from __future__ import annotations

import asyncio
import bisect
import functools
from collections import OrderedDict
from collections.abc import Sequence
from concurrent.futures import Future
from typing import Final

from recorder.mcap.store import Store
from replay.storage.limits import limits
from replay.storage.location import Url
from replay.storage.servers import SPARE_SECONDS, Part, RemoteError, connect, refusal
from replay.storage.tries import Again, patiently

EDGE_BYTES: Final = 64 * 1024
"""What is read of the beginning, and of the end, at once."""
CACHE_BYTES: Final = 16 * 1024 * 1024
"""Bytes of an object that are kept; the last part always is."""
_LEAST: Final = 16 * 1024
_MOST: Final = 1024 * 1024
_AT_ONCE: Final = 16


class RemoteStore(Store):
    """An object on a server, read part by part; `tag` names its version (ETag or date)."""

    remote = True

    def __init__(self, url: Url) -> None:
        """Look for the object and read its beginning; errors as those of `open_store`."""
        super().__init__(url)
        self._url = url
        self._server, self._limits = connect(url), limits()
        self._parts: OrderedDict[int, bytes] = OrderedDict()
        self._begins: list[int] = []
        self._held = 0
        self._spans: list[tuple[int, int]] = []
        self._starts: list[int] = []
        self._ahead: dict[int, tuple[int, Future[Part]]] = {}
        self._reach, self._follows = _LEAST, -1
        self._stride = EDGE_BYTES
        self.size, self.tag = 0, ""
        first = self._wait(self._start(0, EDGE_BYTES), 0, EDGE_BYTES)
        self.size, self.tag = first.total, first.tag
        self._keep(0, self._checked(first, 0, EDGE_BYTES))

    def read_at(self, offset: int, count: int) -> bytes:
        """`count` bytes from `offset` on, fewer only at the end.

        Raises:
            UnreachableError: the server does not give them.
            RemoteError: it gives others, or the object changed.
        """
        count = max(min(count, self.size - offset), 0)
        if not count:
            return b""
        found = self._cached(offset, count)
        if found is None:
            number = bisect.bisect_right(self._starts, offset) - 1
            if number >= 0 and offset + count <= self._spans[number][1]:
                start, data = self._expected(number)
            else:
                start, data = self._unexpected(offset, offset + count)
            self._keep(start, data)
            found = data[offset - start : offset - start + count]
        return found

    def expect(self, spans: Sequence[tuple[int, int]]) -> None:
        """Read the spans ahead of what is read of them."""
        self._drop_ahead()
        self._spans = sorted(spans)
        self._starts = [start for start, _ in self._spans]

    def forget(self) -> None:
        super().forget()
        self._drop_ahead()
        self._parts.clear()
        self._begins.clear()
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
        return start, self._checked(self._wait(self._start(start, stop), start, stop), start, stop)

    def _expected(self, number: int) -> tuple[int, bytes]:
        """Fetch a span that was expected, with those after it, and ask for what comes then."""
        place = self._spans[number][0]
        start = next((a for a, (b, _) in self._ahead.items() if a <= place < b), None)
        if start is None:
            self._drop_ahead()
            self._stride = EDGE_BYTES
            start, stop = self._bundle(number)
            future = self._start(start, stop)
        else:
            self._stride = min(2 * self._stride, _MOST)
            stop, future = self._ahead.pop(start)
        self._ask_ahead(stop)
        return start, self._checked(self._wait(future, start, stop), start, stop)

    def _bundle(self, number: int) -> tuple[int, int]:
        """Expected spans from one on that touch, up to a stride of bytes."""
        start, stop = self._spans[number]
        while number + 1 < len(self._spans) and stop - start < self._stride:
            number += 1
            if self._spans[number][0] != stop:
                break
            stop = self._spans[number][1]
        return start, stop

    def _ask_ahead(self, stop: int) -> None:
        """Ask for a stride of what is expected after a place, without waiting for it."""
        held = sum(end - begin for begin, (end, _) in self._ahead.items())
        stop = max([stop, *(end for end, _ in self._ahead.values())])
        number = bisect.bisect_left(self._starts, stop)
        while number < len(self._spans) and held < self._stride and len(self._ahead) < _AT_ONCE:
            begin, end = self._bundle(number)
            self._ahead[begin] = end, self._start(begin, end)
            held += end - begin
            number = bisect.bisect_left(self._starts, end)

    def _drop_ahead(self) -> None:
        for _, future in self._ahead.values():
            future.cancel()
        self._ahead.clear()

    def _start(self, start: int, stop: int) -> Future[Part]:
        ask = functools.partial(self._server.part, start, stop)
        patient = patiently(ask, self._limits.of(stop - start))
        return asyncio.run_coroutine_threadsafe(patient, self._server.loop)

    def _wait(self, future: Future[Part], start: int, stop: int) -> Part:
        try:
            return future.result(self._limits.of(stop - start) + SPARE_SECONDS)
        except Again as error:
            raise refusal(self._url, error.__cause__ or error) from None
        except Exception as error:
            raise refusal(self._url, error) from None

    def _checked(self, part: Part, start: int, stop: int) -> bytes:
        if (part.total, part.tag) != (self.size, self.tag):
            raise RemoteError(f"{self.path}: it changed while it was read; begin again")
        if len(part.data) != min(stop, self.size) - start:
            raise RemoteError(
                f"{self.path}: the server sent {len(part.data)} bytes of {stop - start} "
                f"at byte {start}"
            )
        return part.data

    def _cached(self, offset: int, count: int) -> bytes | None:
        place = bisect.bisect_right(self._begins, offset) - 1
        if place < 0:
            return None
        start = self._begins[place]
        data = self._parts[start]
        if offset + count > start + len(data):
            return None
        self._parts.move_to_end(start)
        return data[offset - start : offset - start + count]

    def _keep(self, start: int, data: bytes) -> None:
        low = bisect.bisect_left(self._begins, start)
        high = bisect.bisect_left(self._begins, start + len(data))
        for inner in self._begins[low:high]:
            if inner + len(self._parts[inner]) <= start + len(data):
                self._drop(inner)
        if start in self._parts:  # a longer one
            return
        bisect.insort(self._begins, start)
        self._parts[start] = data
        self._held += len(data)
        while self._held > CACHE_BYTES and len(self._parts) > 1:
            self._drop(next(iter(self._parts)))

    def _drop(self, start: int) -> None:
        self._held -= len(self._parts.pop(start))
        del self._begins[bisect.bisect_left(self._begins, start)]
