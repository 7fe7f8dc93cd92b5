"""A viewer that runs, and is told by Rerun's client what to show."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from cdmisfa.core.errors import CdmisfaError
from recorder.log.files import atomic_write
from replay.view.bindings import viewer_client
from replay.view.columns import FRAME
from replay.viewer.program import Program, wait_until

SECONDS = 120.0
"""Longest time for an answer."""


class Steered:
    """A running viewer that is told what to show.

    Args:
        process: the viewer.
        place: where it listens, on this machine, as host:port.

    Raises:
        CdmisfaError: it does not start.
    """

    def __init__(self, process: Program, place: str) -> None:
        self._process = process
        self._client: Any = None

        def connect(_: Any) -> Any:
            client = viewer_client().connect(f"rerun+http://{place}/proxy")
            client.get_state()
            return client

        self._client = self.ask(connect, what="start")

    def ask(
        self, question: Callable[[Any], Any], seconds: float = SECONDS, what: str = "show it"
    ) -> Any:
        """Ask Rerun's client until it answers: what is not painted yet is an error to it.

        Raises:
            CdmisfaError: it did not answer in time, or the viewer has ended.
        """
        what = f"the viewer did not {what}"
        answer = wait_until(lambda: question(self._client), seconds, what, self._process)
        if answer is None:
            raise CdmisfaError(f"the viewer ended: {self._process.last_words()}")
        return answer

    def go_to(self, frame: int) -> None:
        """Put the time cursor on a frame, once what is shown has been read."""

        def move(client: Any) -> bool:
            if painted := is_painted(client.get_state()):
                client.set_time(FRAME, sequence=frame, play_state="paused")
            return painted

        self.ask(move)

    def draw(self, out: Path) -> None:
        """Write the window as a PNG, whole or not at all."""
        png = bytes(self.ask(lambda client: client.take_screenshot()))
        with atomic_write(out) as partial:
            partial.write_bytes(png)


def is_painted(state: Any) -> bool:
    """Whether a viewer shows all that it was given."""
    return bool(state.recordings) and bool(state.views) and not state.loading
