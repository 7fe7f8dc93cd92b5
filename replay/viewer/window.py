"""Showing a view: in a window, or in a browser on this machine."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from cdmisfa.core.errors import CdmisfaError
from replay.view.build import view_of
from replay.viewer.display import has_display
from replay.viewer.program import check_limit, free_port, run_program
from replay.viewer.webpage import serve_page


def open_window(
    path: Path, *, every: int = 10, all_views: Path | None = None, memory_limit: str = "2GB"
) -> None:
    """Show a run or recording in the viewer, until its window is closed.

    Raises:
        UsageError: no such limit of memory.
        CdmisfaError: there is no display, or the viewer ended with an error.
    """
    check_limit(memory_limit)
    if path.exists() and not has_display():  # a wrong path is said first, below
        raise CdmisfaError(
            "no display (neither DISPLAY nor WAYLAND_DISPLAY is set): use --web, --save or "
            "--screenshot"
        )
    with _opened(path, every, all_views) as (name, view):
        port = str(free_port())
        run_program(
            [name, "--bind", "127.0.0.1", "--port", port, "--memory-limit", memory_limit], view
        )


def serve(
    path: Path,
    *,
    every: int = 10,
    all_views: Path | None = None,
    memory_limit: str = "2GB",
    port: int | None = None,
) -> None:
    """Serve the viewer and a run to browsers on this machine, until interrupted.

    Prints the address on stderr.

    Raises:
        UsageError: no such limit of memory.
        CdmisfaError: the server ended with an error.
    """
    check_limit(memory_limit)
    data_port, viewer_port, page_port = free_port(), free_port(), port or free_port()
    with (
        _opened(path, every, all_views) as (name, view),
        serve_page(viewer_port, data_port, page_port),
    ):
        proxy = f"rerun%2Bhttp%3A%2F%2F127.0.0.1%3A{data_port}%2Fproxy"
        print(f"http://127.0.0.1:{page_port}/?url={proxy}", file=sys.stderr, flush=True)
        run_program(
            [
                "--serve-web",
                *("--bind", "127.0.0.1"),
                *("--port", str(data_port)),
                *("--web-viewer-port", str(viewer_port)),
                *("--server-memory-limit", memory_limit),
                name,
            ],
            view,
        )


@contextlib.contextmanager
def _opened(
    path: Path, every: int, all_views: Path | None
) -> Iterator[tuple[str, BinaryIO | None]]:
    """The view of a run as the viewer's argument, and as its standard input.

    The file has no name any more when it is read, so that it goes with its last reader,
    whatever ends us. Windows cannot do that and keeps the name.
    """
    with contextlib.ExitStack() as until_read:
        view = until_read.enter_context(view_of(path, every, all_views))
        if os.name == "nt" or view == path:
            yield str(view), None
            return
        with open(view, "rb") as file:
            until_read.close()
            yield "-", file
