"""A Rerun recording served while it grows, to viewers on this machine who know its address."""

from __future__ import annotations

import contextlib
from http.server import BaseHTTPRequestHandler

import rerun as rr

from cdmisfa.core.errors import CdmisfaError
from replay.viewer.guarded import served
from replay.viewer.stream import Stream

LAST_SECONDS = 5.0
"""Longest wait for viewers to take the last piece."""

MEMORY = 1 << 30
"""Most bytes that are kept for viewers that connect later; the oldest go first."""


class Broadcast:
    """Serves what a recording is given, piece by piece.

    Args:
        recording: ended by `close`.
        name: of the file that viewers see.
        port: to listen at; by default a free one.

    Attributes:
        address: where viewers find it.

    Raises:
        CdmisfaError: the port is taken, or Rerun is switched off.
    """

    def __init__(self, recording: rr.RecordingStream, name: str, port: int | None = None) -> None:
        if not rr.is_enabled(recording):
            raise CdmisfaError("no live view: Rerun is switched off, unset the variable RERUN")
        self._recording, self._name = recording, name
        self._encoded = rr.binary_stream(recording)
        self._stream = Stream(MEMORY)
        self._serving = contextlib.ExitStack()
        try:
            address = self._serving.enter_context(served(self._answer, port))
        except OSError as error:
            raise CdmisfaError(f"no live view at port {port}: {error.strerror}") from error
        self.address = f"{address}{name}"

    def _answer(self, request: BaseHTTPRequestHandler, path: str) -> None:
        if path != self._name:
            request.send_error(404)
            return
        request.send_response(200)
        request.send_header("Content-Type", "application/octet-stream")
        request.send_header("Cache-Control", "no-store")
        request.end_headers()
        for piece in self._stream.read():
            request.wfile.write(piece)

    def hand_over(self) -> None:
        """Let viewers have what the recording was given."""
        if piece := self._encoded.read(flush=True):
            self._stream.add(piece)

    def close(self) -> None:
        """Hand over the rest and stop serving; a viewer keeps what it has."""
        self.hand_over()
        self._stream.end(LAST_SECONDS)
        self._serving.close()
        self._recording.disconnect()
