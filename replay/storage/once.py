"""Bytes of a store that are asked for more than once, and read once."""

from __future__ import annotations

from collections import deque
from typing import Final

from recorder.mcap.checksum import crc32
from replay.storage.store import Store

MAX_HELD: Final = 512 * 1024 * 1024
"""Most bytes that a pass holds; what lies farther ahead is read without it."""


class Excerpt(Store):
    """A store of which the bytes [start, stop) are in memory."""

    def __init__(self, store: Store, start: int, stop: int) -> None:
        super().__init__(store.path)
        self.size = store.size
        self._store, self._start = store, start
        self._data = store.read(start, stop - start)

    def read_at(self, offset: int, count: int) -> bytes:
        at = offset - self._start
        if 0 <= at < len(self._data):
            return self._data[at : at + count]
        return self._store.read_at(offset, count)

    def close(self) -> None:
        """Nothing: the store stays open."""


class OnePass(Store):
    """A store that is read from its beginning on, with the checksum of every byte passed.

    What was read is held until it is passed; what lies between is read for the checksum.
    """

    def __init__(self, store: Store) -> None:
        super().__init__(store.path)
        self.size = store.size
        self._store = store
        self._at = 0
        self._crc = 0
        self._held: deque[bytes] = deque()
        self._end = 0

    def read_at(self, offset: int, count: int) -> bytes:
        if offset < self._at or offset + count - self._at > MAX_HELD:
            return self._store.read_at(offset, count)
        for place in (offset, offset + count):
            if place > self._end and (part := self._store.read(self._end, place - self._end)):
                self._held.append(part)
                self._end += len(part)
        at = self._at
        for part in self._held:
            if offset < at + len(part):
                return part[offset - at : offset - at + count]
            at += len(part)
        return b""

    def pass_to(self, place: int) -> None:
        """Go on to a place: nothing before it is asked for any more."""
        while self._held and self._at < place:
            part = self._held.popleft()
            if self._at + len(part) > place:
                self._held.appendleft(part[place - self._at :])
                part = part[: place - self._at]
            self._crc = crc32(part, self._crc)
            self._at += len(part)
        for block in self._store.blocks(self._at, place if not self._held else self._at):
            self._crc = crc32(block, self._crc)
            self._at += len(block)
        self._end = max(self._end, self._at)

    def crc(self, offset: int, stop: int) -> int:
        """CRC-32 of the bytes [offset, stop); from 0 up to where the pass is, it is known."""
        return self._crc if (offset, stop) == (0, self._at) else super().crc(offset, stop)

    def close(self) -> None:
        """Nothing: the store stays open."""
