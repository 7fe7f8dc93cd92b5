"""The viewer without a window: pictures without a screen."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from cdmisfa.core.errors import CdmisfaError
from recorder.log.files import atomic_write, refuse_taken, refuse_unless_png
from replay.view.bindings import viewer_client
from replay.view.build import view_of
from replay.view.columns import FRAME
from replay.viewer.catalogue import served_table
from replay.viewer.display import missing_driver
from replay.viewer.moments import frame_at
from replay.viewer.program import Program, check_size, free_port, private_host, running

WINDOW = "1600x1000"
SETTLE = 6.0
"""Seconds after which the viewer has painted everything and taken its notices away."""

SECONDS = 120.0
"""Longest time for a picture."""


def screenshot(
    path: Path,
    out: Path,
    *,
    at: int | str | None = None,
    every: int = 10,
    all_views: Path | None = None,
    tab: str | None = None,
    force: bool = False,
    window: str = WINDOW,
) -> None:
    """Draw the view of a run or recording without a screen.

    Args:
        path: a run or recording, or an .rrd file.
        out: the PNG file.
        at: where the time cursor stands, see `frame_at`; by default at the end.
        every: show every so many watched frames.
        all_views: see `build_view`.
        tab: name of the tab that is shown; by default the first.
        force: replace an existing file.
        window: size, as "1600x1000".

    Raises:
        UsageError: `out` is no .png, or exists and `force` is not set, there is no such moment or
            tab, or no such size.
        CdmisfaError: no driver, or the viewer failed.
    """
    refuse_unless_png(out)
    refuse_taken(out, force=force)
    check_size(window)
    frame = None if at is None else frame_at(path, str(at))
    if missing_driver():
        raise CdmisfaError(f"{out} cannot be drawn, {missing_driver()}")
    with view_of(path, every, all_views, tab) as view:
        png = _draw(view, frame, window)
    with atomic_write(out) as partial:
        partial.write_bytes(png)


def _draw(view: Path, at: int | None, window: str) -> bytes:
    """A PNG of the whole window, once everything in it is loaded."""
    with headless_viewer(window) as viewer:
        viewer.ask(lambda client: client.open(str(view)))
        viewer.ask(lambda client: _painted(client.get_state()))
        if at is not None:
            viewer.go_to(at)
        time.sleep(SETTLE)
        viewer.ask(lambda client: _painted(client.get_state()))
        return bytes(viewer.ask(lambda client: client.take_screenshot()))


def draw_table(folder: Path, out: Path, *, force: bool = False, window: str = WINDOW) -> None:
    """Draw the table of a folder of runs without a screen.

    Args:
        folder: of a sweep that kept its logs, or any folder of runs.
        out: the PNG file.
        force: replace an existing file.
        window: size, as "1600x1000".

    Raises:
        UsageError: `out` is no .png, or exists and `force` is not set, no such size, or no run is
            there.
        LogDamagedError: a run without a run.json cannot be read.
        CdmisfaError: no driver, or the viewer or the server failed.
    """
    refuse_unless_png(out)
    refuse_taken(out, force=force)
    check_size(window)
    if missing_driver():
        raise CdmisfaError(f"{out} cannot be drawn, {missing_driver()}")
    with served_table(folder) as table, headless_viewer(window) as viewer:
        if table is None:
            raise CdmisfaError(f"{out} cannot be drawn: the server of runs has ended")
        viewer.ask(lambda client: client.open(table.address) or True)
        time.sleep(SETTLE)
        png = bytes(viewer.ask(lambda client: client.take_screenshot()))
    with atomic_write(out) as partial:
        partial.write_bytes(png)


def _painted(state: Any) -> bool:
    return bool(state.recordings) and bool(state.views) and not state.loading


class HeadlessViewer:
    """A running viewer without a window.

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
        end, refusal = time.monotonic() + seconds, ""
        while time.monotonic() < end:
            try:
                answer = question(self._client)
                if answer:
                    return answer
            except (OSError, RuntimeError, ValueError) as error:
                refusal = f": {error}".splitlines()[0]
            if self._process.poll() is not None:
                raise CdmisfaError(f"the viewer ended: {self._process.last_words()}")
            time.sleep(0.1)
        raise CdmisfaError(f"the viewer did not {what} within {seconds:.0f} s{refusal}")

    def go_to(self, frame: int) -> None:
        """Put the time cursor on a frame."""

        def move(client: Any) -> bool:
            client.set_time(FRAME, sequence=frame, play_state="paused")
            return True

        self.ask(move)


@contextlib.contextmanager
def headless_viewer(window: str = WINDOW) -> Iterator[HeadlessViewer]:
    """A viewer without a window; ended on the way out.

    Raises:
        CdmisfaError: it does not start.
    """
    host = private_host()
    port = free_port(host)
    place = ["--port", str(port), "--bind", host, "--window-size", window]
    with running(["--headless", "--hide-welcome-screen", *place]) as process:
        yield HeadlessViewer(process, f"{host}:{port}")
