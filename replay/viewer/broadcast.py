"""A Rerun recording served while it grows, to viewers on this machine who know its address."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Iterator

import rerun as rr

from cdmisfa.core.errors import CdmisfaError
from replay.view.properties import APPLICATION
from replay.viewer.program import free_port, open_growing, running
from replay.viewer.web import page_of, page_server, served, shown_at

FIRST = 2
"""Pieces at the beginning, which name the recording and its lines, and never go."""

LAST_SECONDS = 1.0
"""Longest wait for viewers to take the last piece."""

MEMORY = 1 << 30
"""Most bytes that are kept for viewers that connect later; the oldest go first."""


class Broadcast:
    """A new Rerun recording, and what it is given served piece by piece.

    A browser and a window's standard input wait for what comes as long as it takes. A window that
    is given the address of the data ends its request after 30 s: Rerun knows no other limit.

    Args:
        kind: of recording, a word for its name.
        port: to listen at; by default a free one.

    Attributes:
        recording: what is served; ended by `close`.
        address: of the page that shows it.

    Raises:
        CdmisfaError: the port is taken, or Rerun is switched off.
    """

    def __init__(self, kind: str, port: int | None = None) -> None:
        self._pieces = Pieces(MEMORY)
        with contextlib.ExitStack() as serving:
            viewer_port = free_port()
            page = page_of(viewer_port, self._pieces.read)
            self.address = shown_at(serving.enter_context(served(page, port)))
            serving.enter_context(running(page_server(viewer_port)))
            self.recording = rr.RecordingStream(APPLICATION, recording_id=f"{kind}-{os.getpid()}")
            if not rr.is_enabled(self.recording):
                raise CdmisfaError("no live view: Rerun is switched off, unset the variable RERUN")
            self._serving = serving.pop_all()
        self.recording.set_log_time_enabled(False)
        self._encoded = rr.binary_stream(self.recording)

    def open_window(self) -> None:
        """Open a viewer that shows it; it stays open when we have ended."""
        open_growing(self._pieces.read())

    def hand_over(self) -> None:
        """Let viewers have what the recording was given."""
        if piece := self._encoded.read(flush=True):
            self._pieces.add(piece)

    def close(self) -> None:
        """Hand over the rest and stop serving; a viewer keeps what it has."""
        self.hand_over()
        self._pieces.end(LAST_SECONDS)
        with contextlib.suppress(CdmisfaError):  # the page's program may have got our Ctrl-C, too
            self._serving.close()
        self.recording.disconnect()


class Pieces:
    """Pieces of a recording that grows, for readers that come when they like.

    No reader is waited for; the oldest pieces go where memory ends.

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
