"""Showing a view: in a window, in a browser on this machine, or in a frame of a page there."""

from __future__ import annotations

import atexit
import contextlib
import functools
import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from cdmisfa.core.errors import CdmisfaError
from replay.inputs import About
from replay.view.build import view_of
from replay.viewer.catalogue import served_moment
from replay.viewer.moments import frame_at
from replay.viewer.program import (
    Program,
    check_limit,
    check_window,
    free_port,
    has_display,
    private_host,
    run_program,
    running,
    tell,
)
from replay.viewer.steered import Steered
from replay.viewer.web import page_of, page_server, pieces_of, served, shown_at


def open_window(
    path: Path,
    *,
    at: str | None = None,
    every: int = 10,
    all_views: Path | None = None,
    tab: str | None = None,
    memory_limit: str = "2GB",
    size: str | None = None,
    about: About = lambda source: None,
) -> None:
    """Show a run or recording in the viewer, at a moment (`frame_at`), until its window is closed.

    Raises:
        UsageError: no such limit of memory, size, tab or moment.
        CdmisfaError: there is no display, or the viewer ended with an error.
    """
    check_limit(memory_limit)
    window = [] if size is None else ["--window-size", check_window(size)]
    if path.exists():  # a wrong path is said first, below
        refuse_without_display()
    frame = None if at is None else frame_at(path, at)
    with _opened(path, every, all_views, tab, about) as (name, view):
        host = private_host()
        port = str(free_port(host))
        place = ("--bind", host, "--port", port)
        arguments = [name, *place, *window, "--memory-limit", memory_limit]
        if frame is None:
            run_program(arguments, view)
        else:
            run_program(arguments, view, lambda viewer: _go_to(frame, viewer, f"{host}:{port}"))


def _go_to(frame: int, viewer: Program, place: str) -> None:
    """Put the time cursor of a window on a frame; that it was closed meanwhile is no error."""
    try:
        Steered(viewer, place).go_to(frame)
    except CdmisfaError as error:
        if viewer.poll() is None:
            tell(f"frame {frame} is not shown: {error}")


def refuse_without_display() -> None:
    """Refuse to open a window where there can be none.

    Raises:
        CdmisfaError: there is no display.
    """
    if not has_display():
        raise CdmisfaError(
            "no display (neither DISPLAY nor WAYLAND_DISPLAY is set): use --web, --save or "
            "--screenshot"
        )


def serve(
    path: Path,
    *,
    at: str | None = None,
    every: int = 10,
    all_views: Path | None = None,
    tab: str | None = None,
    memory_limit: str = "2GB",
    port: int | None = None,
    about: About = lambda source: None,
) -> None:
    """Serve the viewer and a run to browsers on this machine, until interrupted.

    Prints the address on stderr. With a moment (`frame_at`) it opens there.

    Raises:
        UsageError: no such limit of memory or moment.
        CdmisfaError: the server ended with an error.
    """
    check_limit(memory_limit)
    viewer_port = free_port()
    with contextlib.ExitStack() as opened:
        if at is not None:
            frame = frame_at(path, at)
            moment = opened.enter_context(view_of(path, every, all_views, tab, about))
            server, address = opened.enter_context(served_moment(moment, frame, port))
            tell(address)
            server.wait()
            return
        name, file = opened.enter_context(_opened(path, every, all_views, tab, about))
        view = file or opened.enter_context(open(name, "rb"))
        page = page_of(viewer_port, lambda: pieces_of(view))
        address = opened.enter_context(served(page, port))
        tell(shown_at(address))
        run_program(page_server(viewer_port))


def serve_frame(path: Path) -> str:
    """Serve the viewer and a view to pages that show it in a frame, until this process ends.

    Rerun's own widget for notebooks asks other hosts than this machine, also where its code is
    served by it; this page cannot, see `POLICY`.

    Args:
        path: an .rrd file; on POSIX systems it may be removed afterwards.

    Returns:
        The address, which ends with the process.

    Raises:
        CdmisfaError: no port is free.
    """
    port, view = _page_port(), _until_exit.enter_context(path.open("rb"))
    page = page_of(port, lambda: pieces_of(view), framed=True)
    return shown_at(_until_exit.enter_context(served(page)))


_until_exit = contextlib.ExitStack()
atexit.register(_until_exit.close)


@functools.cache
def _page_port() -> int:
    """The port of the viewer's page, which is the same in all frames of this process.

    Its server is not in our group of processes, which notebooks interrupt as a whole.
    """
    port = free_port()
    _until_exit.enter_context(running(page_server(port), apart=True))
    return port


@contextlib.contextmanager
def _opened(
    path: Path, every: int, all_views: Path | None, tab: str | None, about: About
) -> Iterator[tuple[str, BinaryIO | None]]:
    """The view of a run as the viewer's argument, and as its standard input.

    The file has no name any more when it is read, so that it goes with its last reader,
    whatever ends us. Windows cannot do that and keeps the name.
    """
    with contextlib.ExitStack() as until_read:
        view = until_read.enter_context(view_of(path, every, all_views, tab, about))
        if os.name == "nt" or view == path:
            yield str(view), None
            return
        with open(view, "rb") as file:
            until_read.close()
            yield "-", file
