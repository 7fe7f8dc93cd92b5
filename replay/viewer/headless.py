"""Pictures of a view without a screen, at a moment of a run: a frame, iteration or event."""

from __future__ import annotations

import contextlib
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from cdmisfa.core.errors import CdmisfaError, UsageError
from recorder.log.files import atomic_write, refuse_taken, refuse_unless
from replay.inputs import About, holds_run, open_to_look
from replay.recordings.source import RecordedSource
from replay.runs.log import EVENT_TOPIC, read_batches, read_columns, read_header
from replay.view.bindings import viewer_client
from replay.view.build import view_of
from replay.view.columns import FRAME
from replay.viewer.catalogue import served_table
from replay.viewer.program import (
    Program,
    check_window,
    free_port,
    missing_driver,
    private_host,
    running,
    wait_until,
)

ITERATION = re.compile(r"(?:iteration|iter|i)\s*(\d+)", re.IGNORECASE)

TOLD = 3
"""Events that a refusal names."""

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
        viewer.ask(lambda client: _painted(client.get_state()))
        if frame is not None:
            viewer.go_to(frame)
        time.sleep(SETTLE)
        viewer.ask(lambda client: _painted(client.get_state()))
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
        what = f"the viewer did not {what}"
        answer = wait_until(lambda: question(self._client), seconds, what, self._process)
        if answer is None:
            raise CdmisfaError(f"the viewer ended: {self._process.last_words()}")
        return answer

    def go_to(self, frame: int) -> None:
        """Put the time cursor on a frame."""

        def move(client: Any) -> bool:
            client.set_time(FRAME, sequence=frame, play_state="paused")
            return True

        self.ask(move)

    def draw(self, out: Path) -> None:
        """Write the window as a PNG, whole or not at all."""
        png = bytes(self.ask(lambda client: client.take_screenshot()))
        with atomic_write(out) as partial:
            partial.write_bytes(png)


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


def frame_at(path: Path, at: str) -> int:
    """The frame of a moment.

    Args:
        path: a run or recording, or an .rrd file.
        at: a frame, as "20000"; of a run also an iteration, as "iteration 500", or words of an
            event, as "module 2": the first one that has them.

    Raises:
        UsageError: there is no such moment.
        LogDamagedError: the log cannot be read.
    """
    if at.isdecimal():
        frame = int(at)
        if path.suffix != ".rrd" and frame > (last := _last_frame(path)):
            raise UsageError(f"--at {at}: there is no such frame, the last of {path} is {last}")
        return frame
    if path.suffix == ".rrd" or not holds_run(path):
        raise UsageError(f"--at {at}: only a run has iterations and events, say a frame")
    found = ITERATION.fullmatch(at.strip())
    return _of_iteration(path, int(found[1])) if found else _of_event(path, at)


def _of_iteration(run: Path, iteration: int) -> int:
    last = -1
    for columns in read_columns(run):
        last = int(columns.iterations[-1])
        if iteration <= last:
            return int(columns.frames[columns.iterations.tolist().index(iteration)])
    raise UsageError(f"--at iteration {iteration}: the last of {run} is {last}")


def _of_event(run: Path, words: str) -> int:
    wanted = re.compile(rf"(?<!\w){re.escape(words.strip())}(?!\w)", re.IGNORECASE)
    told: list[str] = []
    for batch in read_batches(run, read_header(run), topics=(EVENT_TOPIC,)):
        for event in batch.events:
            if wanted.search(event.text):
                return int(event.t)
            told.append(event.text)
    some = "; ".join(told[:TOLD]) or "none"
    raise UsageError(f"--at {words!r} is no frame, iteration or event of {run}; events: {some}")


def _last_frame(path: Path) -> int:
    if holds_run(path):
        ends = (int(piece.frames[-1]) + piece.tau - 1 for piece in read_columns(path))
        return max(ends, default=0)
    with contextlib.closing(open_to_look([path], salvage=True)) as source:
        if isinstance(source, RecordedSource):
            return max(ranges[-1][1] for ranges in source.coverage().values() if ranges) - 1
        return source.frames - 1
