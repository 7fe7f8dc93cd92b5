"""Pictures of a view without a screen."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path

from cdmisfa.core.errors import CdmisfaError
from recorder.log.files import refuse_taken, refuse_unless
from replay.inputs import About
from replay.view.build import view_of
from replay.viewer.catalogue import served_table
from replay.viewer.moments import frame_at
from replay.viewer.program import (
    check_window,
    free_port,
    missing_driver,
    private_host,
    running,
)
from replay.viewer.steered import Steered, is_painted

WINDOW = "1600x1000"
SETTLE = 6.0
"""Seconds after which the viewer has painted everything and taken its notices away."""


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
    about: About = lambda source: None,
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
        about: see `build_view`.

    Raises:
        UsageError: `out` is no .png, or exists and `force` is not set, there is no such moment or
            tab, or no such size.
        CdmisfaError: no driver, or the viewer failed.
    """
    frame = None if at is None else frame_at(path, str(at))
    _refuse(out, window, force=force)
    with view_of(path, every, all_views, tab, about) as view, headless_viewer(window) as viewer:
        viewer.ask(lambda client: client.open(str(view)))
        viewer.ask(lambda client: is_painted(client.get_state()))
        if frame is not None:
            viewer.go_to(frame)
        time.sleep(SETTLE)
        viewer.ask(lambda client: is_painted(client.get_state()))
        viewer.draw(out)


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
    _refuse(out, window, force=force)
    with served_table(folder) as table, headless_viewer(window) as viewer:
        if table is None:
            raise CdmisfaError(f"{out} cannot be drawn: the server of runs has ended")
        viewer.ask(lambda client: client.open(table.address) or True)
        time.sleep(SETTLE)
        viewer.draw(out)


def _refuse(out: Path, window: str, *, force: bool) -> None:
    refuse_unless(out, "the picture is a PNG", ".png")
    refuse_taken(out, force=force)
    check_window(window)
    if missing_driver():
        raise CdmisfaError(f"{out} cannot be drawn, {missing_driver()}")


@contextlib.contextmanager
def headless_viewer(window: str = WINDOW) -> Iterator[Steered]:
    """A viewer without a window; ended on the way out.

    Raises:
        CdmisfaError: it does not start.
    """
    host = private_host()
    port = free_port(host)
    place = ["--port", str(port), "--bind", host, "--window-size", window]
    with running(["--headless", "--hide-welcome-screen", *place]) as process:
        yield Steered(process, f"{host}:{port}")
