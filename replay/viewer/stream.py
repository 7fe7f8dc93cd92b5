"""A recording that grows, for readers that come when they like and are never waited for."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

FIRST = 2
"""Pieces at the beginning, which name the recording and its lines, and never go."""


class Stream:
    """Pieces of a recording in the order in which they came; the oldest go where memory ends.

    Args:
        most: bytes that are kept.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._pieces: dict[int, bytes] = {}
        self._count = self._held = self._readers = 0
        self._oldest = FIRST
        self._ended = False
        self._changed = threading.Condition()

    def add(self, piece: bytes) -> None:
        """Hand over a piece, which is a whole recording: viewers take one after the other."""
        with self._changed:
            self._pieces[self._count] = piece
            self._count += 1
            self._held += len(piece)
            while self._held > self._most and self._oldest < self._count - 1:
                self._held -= len(self._pieces.pop(self._oldest))
                self._oldest += 1
            self._changed.notify_all()

    def end(self, seconds: float) -> None:
        """No more comes; wait so long for readers to take the rest."""
        until = time.monotonic() + seconds
        with self._changed:
            self._ended = True
            self._changed.notify_all()
            while self._readers and (left := until - time.monotonic()) > 0:
                self._changed.wait(left)

    def read(self) -> Iterator[bytes]:
        """Every piece that is kept, and those that come, until the end."""
        with self._changed:
            self._readers += 1
        try:
            number = 0
            while (found := self._piece(number)) is not None:
                number, piece = found
                yield piece
        finally:
            with self._changed:
                self._readers -= 1
                self._changed.notify_all()

    def _piece(self, number: int) -> tuple[int, bytes] | None:
        """A piece by its number, or the oldest after it; and the number of the next one."""
        with self._changed:
            while True:
                if number >= FIRST:
                    number = max(number, self._oldest)
                if number < self._count:
                    return number + 1, self._pieces[number]
                if self._ended:
                    return None
                self._changed.wait()
