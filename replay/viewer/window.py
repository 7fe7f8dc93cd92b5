"""Opening a view: in a window, in a browser on this machine, or as a picture without a screen."""

from __future__ import annotations

import contextlib
import glob
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

from cdmisfa.core.errors import CdmisfaError, UsageError
from recorder.log.whole import partial_path
from replay.recordings.source import RecordedSource
from replay.runs.folders import is_run
from replay.runs.stretches import read_signals
from replay.view.build import build_view
from replay.view.columns import FRAME
from replay.viewer.program import (
    check_limit,
    ends_with_parent,
    environment,
    free_port,
    has_display,
    last_words,
    program,
    run_program,
    stop,
)
from replay.viewer.webpage import serve_page

DRIVERS = "/usr/share/vulkan/icd.d/*.json"
"""Where Linux keeps the descriptions of Vulkan drivers."""

INSTALL = "apt-get install mesa-vulkan-drivers libvulkan1"
"""What gives a machine without a graphics card a driver."""

WINDOW = "1600x1000"
SETTLE = 6.0
"""Seconds after which the viewer has painted everything and taken its notices away."""

SECONDS = 120.0
"""Longest time for a picture."""


def missing_driver() -> str:
    """Why no picture can be drawn without a screen here, or "" where it can."""
    if sys.platform.startswith("linux") and not glob.glob(DRIVERS):
        return f"no Vulkan driver is installed: {INSTALL}"
    return ""


def save(
    path: Path, out: Path, *, every: int = 10, all_views: Path | None = None, force: bool = False
) -> None:
    """Write the view of a run or recording to an .rrd file; see `build_view`."""
    build_view(path, out, every=every, all_views=all_views, force=force)


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


def screenshot(
    path: Path,
    out: Path,
    *,
    at: int | None = None,
    every: int = 10,
    all_views: Path | None = None,
    force: bool = False,
    window: str = WINDOW,
) -> None:
    """Draw the view of a run or recording without a screen.

    Args:
        path: a run or recording, or an .rrd file.
        out: the PNG file.
        at: frame at which the time cursor stands; by default the last.
        every: show every so many watched frames.
        all_views: see `build_view`.
        force: replace an existing file.
        window: size, as "1600x1000".

    Raises:
        UsageError: `out` exists and `force` is not set, or there is no frame `at`.
        CdmisfaError: no driver, or the viewer failed.
    """
    if out.exists() and not force:
        raise UsageError(f"{out} exists: choose another name or overwrite with --force")
    if at is not None and path.suffix != ".rrd" and at > (last := _last_frame(path)):
        raise UsageError(f"--at {at}: there is no such frame, the last of {path} is {last}")
    if missing_driver():
        raise CdmisfaError(f"{out} cannot be drawn, {missing_driver()}")
    with _view_of(path, every, all_views) as view:
        png = _draw(view, at, window)
    partial = partial_path(out)
    try:
        partial.write_bytes(png)
        os.replace(partial, out)
    except OSError as error:
        raise CdmisfaError(f"{out} cannot be written: {error.strerror or error}") from error


def _last_frame(path: Path) -> int:
    if is_run(path):
        return max((int(s.t) + len(s.y) - 1 for s in read_signals(path)), default=0)
    with contextlib.closing(RecordedSource(path, salvage=True)) as source:
        return max(ranges[-1][1] for ranges in source.coverage().values()) - 1


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


def _painted(state: Any) -> bool:
    return bool(state.recordings) and bool(state.views) and not state.loading


class HeadlessViewer:
    """A running viewer without a window.

    Args:
        client: Rerun's `ViewerClient`, connected to it.
        process: the viewer.
        words: where its output goes.
    """

    def __init__(self, client: Any, process: subprocess.Popen[bytes], words: BinaryIO) -> None:
        self._client = client
        self._process = process
        self._words = words

    def ask(self, question: Callable[[Any], Any], seconds: float = SECONDS) -> Any:
        """Ask the client until it answers: what is not painted yet is an error to it.

        Raises:
            CdmisfaError: it did not answer in time, or the viewer has ended.
        """
        end, refusal = time.monotonic() + seconds, ""
        while time.monotonic() < end:
            try:
                answer = question(self._client)
                if answer:
                    return answer
            except (ConnectionError, RuntimeError) as error:
                refusal = f": {error}".splitlines()[0]
            if self._process.poll() is not None:
                raise CdmisfaError(f"the viewer ended: {last_words(self._words)}")
            time.sleep(0.1)
        raise CdmisfaError(f"the viewer did not show it within {seconds:.0f} s{refusal}")

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
    from rerun.experimental import ViewerClient

    port = free_port()
    command = [str(program()), "--headless", "--hide-welcome-screen"]
    command += ["--port", str(port), "--bind", "127.0.0.1", "--window-size", window]
    with tempfile.TemporaryFile() as words:
        # Output goes to a file: the viewer hangs when nobody empties a pipe.
        process = subprocess.Popen(
            command,
            env=environment(),
            stdout=words,
            stderr=words,
            preexec_fn=ends_with_parent(),
        )
        try:
            client = _connected(ViewerClient, port, process, words)
            yield HeadlessViewer(client, process, words)
        finally:
            stop(process)


def _connected(client: Any, port: int, process: subprocess.Popen[bytes], words: BinaryIO) -> Any:
    end = time.monotonic() + SECONDS
    while time.monotonic() < end:
        if process.poll() is not None:
            raise CdmisfaError(f"the viewer did not start: {last_words(words)}")
        try:
            viewer = client.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            viewer.get_state()
            return viewer
        except (ConnectionError, RuntimeError, OSError, ValueError):
            time.sleep(0.1)
    raise CdmisfaError(f"the viewer did not start within {SECONDS:.0f} s")


@contextlib.contextmanager
def _view_of(path: Path, every: int, all_views: Path | None) -> Iterator[Path]:
    """The view of a run, built for as long as it is looked at."""
    if path.suffix == ".rrd":
        if not path.is_file():
            raise UsageError(f"{path} does not exist: name a run, a recording or an .rrd file")
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="cdmisfa-view-") as folder:
        view = Path(folder) / f"{path.resolve().stem}.rrd"
        build_view(path, view, every=every, all_views=all_views)
        yield view


@contextlib.contextmanager
def _opened(
    path: Path, every: int, all_views: Path | None
) -> Iterator[tuple[str, BinaryIO | None]]:
    """The view of a run as the viewer's argument, and as its standard input.

    The file has no name any more when it is read, so that it goes with its last reader,
    whatever ends us. Windows cannot do that and keeps the name.
    """
    with contextlib.ExitStack() as until_read:
        view = until_read.enter_context(_view_of(path, every, all_views))
        if os.name == "nt" or view == path:
            yield str(view), None
            return
        with open(view, "rb") as file:
            until_read.close()
            yield "-", file
