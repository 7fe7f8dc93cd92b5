"""Many runs in one table: Rerun's own catalogue server over a folder of runs.

A row is a run, its columns are the run's configuration and result; from there each run
is opened in its own view. The rows come first, from the files run.json; the views, which
are larger and may have to be built, follow as a second layer of the same recordings. Only
programs on this machine can connect.
"""

from __future__ import annotations

import contextlib
import re
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlsplit

from cdmisfa.core.errors import CdmisfaError, UsageError
from replay.runs.folders import VIEW_FILE, run_log, runs_in
from replay.view.bindings import CatalogueClient, RrdReader
from replay.view.properties import APPLICATION, read_properties, run_identity, write_rows
from replay.viewer.program import (
    REFUSALS,
    Program,
    free_port,
    has_display,
    open_privately,
    private_host,
    running,
    tell,
    wait_until,
)
from replay.viewer.web import page_of, page_server, served

ROWS = "base"
"""Name of the layer of rows."""

LAYER = "view"
"""Name of the layer of views, beside that of the rows."""

TOGETHER = 100
"""Views that are registered at once: each time the server goes over all that it has."""

REGISTER_SECONDS = 300
"""Longest wait for the server to read what is registered at once."""

START_SECONDS = 60.0
"""Longest wait for the server to listen."""

Progress = Callable[[int, int], None]


def ready_view(run: Path) -> Path:
    """The view of a run; built where it is missing, older than the log, or of another run.

    Raises:
        LogDamagedError: the run cannot be read.
        CdmisfaError: the view cannot be written.
    """
    from replay.view.build import build_view  # only where a view is missing

    view, log = run / VIEW_FILE, run_log(run)
    old = not view.is_file() or view.stat().st_mtime < log.stat().st_mtime
    if old or _identity(view) != run_identity(run):  # the copy of a run brings its view along
        build_view(run, view, body=False)
    return view


@dataclass(frozen=True, slots=True)
class Table:
    """A table of runs that is served.

    Attributes:
        server: the program.
        runs: folders of runs.
        rows: how many of them have a row.
        dataset: the server's, with the rows.
        place: folder for files.
        address: of the table.
    """

    server: Program
    runs: Sequence[Path]
    rows: int
    dataset: Any
    place: Path
    address: str


@contextlib.contextmanager
def served_table(folder: Path, port: int | None = None) -> Iterator[Table | None]:
    """Serve the table of a folder of runs while the body runs; None where the server has ended.

    A run that the server refuses is named on stderr.

    Args:
        folder: of a sweep that kept its logs, or any folder of runs.
        port: to listen at; by default a free one.

    Raises:
        UsageError: there is no run in it.
        LogDamagedError: a run without a run.json cannot be read.
        CdmisfaError: the port is taken, or the server ended with an error.
    """
    runs = runs_in(folder)
    if not runs:
        raise UsageError(f"{folder} holds no runs")
    with (
        tempfile.TemporaryDirectory(prefix="cdmisfa-runs-") as place,
        _server(port) as (server, address),
    ):
        files = write_rows(runs, Path(place))  # while the server starts
        dataset = _created(address, _dataset_name(folder), server)
        if dataset is None:
            yield None
            return
        refused = _register(dataset, files, ROWS)
        for file, reason in refused.items():
            tell(f"{runs[files.index(file)]} has no row: {reason}")
        table = f"{address}/entry/{dataset.entry_details().id}"
        yield Table(server, runs, len(runs) - len(refused), dataset, Path(place), table)


def serve_catalogue(
    folder: Path,
    *,
    port: int | None = None,
    tab: str | None = None,
    web: bool = False,
    progress: Progress | None = None,
) -> None:
    """Serve a folder of runs until interrupted, and open it where there is a display.

    Prints the address of their table on stderr as soon as it is there; the views that the
    rows lead to follow. A run whose view cannot be made is named on stderr.

    Args:
        folder: of a sweep that kept its logs, or any folder of runs.
        port: to listen at; by default a free one.
        tab: name of the tab in which a run opens; by default the first.
        web: serve the viewer, too, to a browser on this machine, at `port`.
        progress: called with the views that are ready, and all.

    Raises:
        UsageError: there is no run in it.
        LogDamagedError: a run without a run.json cannot be read.
        CdmisfaError: the server ended with an error.
    """
    with contextlib.ExitStack() as opened:
        table = opened.enter_context(served_table(folder, None if web else port))
        if table is None:
            return
        shown = f"{table.rows} runs at {table.address}    look at them: rerun {table.address}"
        if web:
            page = opened.enter_context(_page_that_shows(table.address, port))
            shown = f"{table.rows} runs at {page}"
        tell(shown)
        if has_display() and not web:
            open_privately(table.address)
        try:
            set_layout(table.runs, table.dataset, table.place, tab)
        except (CdmisfaError, *REFUSALS) as error:
            tell(f"runs are shown without their layout: {error}")
        try:
            add_views(table.runs, table.dataset, table.place, progress)
        except REFUSALS as error:
            time.sleep(1.0)  # when interrupted the server may die before us; that is no error
            tell(f"views are not served: {error}")
        table.server.wait()


@contextlib.contextmanager
def served_moment(view: Path, frame: int, port: int | None = None) -> Iterator[tuple[Program, str]]:
    """Serve a view to a browser that opens it at a frame, while the body runs.

    A file of Rerun's has no place for a moment; a link to what its server has, does.

    Args:
        view: an .rrd file, which stays there.
        frame: where the time cursor stands.
        port: where the page is served; by default at a free one.

    Yields:
        The server, and the address of the page.

    Raises:
        CdmisfaError: the port is taken, or the server refuses the view or ended.
    """
    from replay.view.columns import FRAME  # imports the package

    with _server() as (server, address):
        dataset = _created(address, _dataset_name(view.with_suffix("")), server)
        refused = {} if dataset is None else _register(dataset, [view], ROWS)
        if dataset is None or refused:
            why = server.last_words() if dataset is None else refused[view]
            raise CdmisfaError(f"{view} is not served: {why}")
        _set_layout(dataset, view)
        shown = f"dataset/{dataset.entry_details().id}?segment_id={quote(_identity(view))}"
        link = f"{address}/{shown}#when={FRAME}@{frame}"
        with _page_that_shows(link, port) as page:
            yield server, page


@contextlib.contextmanager
def _server(port: int | None = None) -> Iterator[tuple[Program, str]]:
    """A server of runs, and its address, while the body runs."""
    host = private_host()
    port = free_port(host, port or 0)  # else whoever has it might be asked instead of the server
    with running(["server", "--host", host, "--port", str(port)]) as server:
        yield server, f"rerun+http://{host}:{port}"


@contextlib.contextmanager
def _page_that_shows(link: str, port: int | None) -> Iterator[str]:
    """Serve the viewer's page to show what a server of runs has, and give its address."""
    viewer_port, place = free_port(), f"http://{urlsplit(link).netloc}"
    with (
        running(page_server(viewer_port)),
        served(page_of(viewer_port, data=place), port) as address,
    ):
        yield f"{address}?url={quote(link, safe='')}"


def _created(address: str, name: str, server: Program) -> Any:
    """A new dataset of a server that is starting; None where the server has ended.

    Raises:
        CdmisfaError: it does not listen in time.
    """

    def create() -> Any:
        return CatalogueClient(address).create_dataset(name)

    return wait_until(create, START_SECONDS, "the server did not start", server)


def set_layout(runs: Sequence[Path], dataset: Any, place: Path, tab: str | None = None) -> None:
    """Make the layout of the run that learned most the one in which every run opens.

    Args:
        runs: folders of runs.
        dataset: the server's.
        place: folder of the layout's file.
        tab: name of the tab that is open; by default the first.

    Raises:
        UsageError: there is no such tab.
        LogDamagedError: that run cannot be read.
    """
    from replay.runs.run import read_outline
    from replay.view.columns import MOST_STREAMS

    # These take half a second: only once the table is there.
    from replay.view.panels import run_layout
    from replay.view.world import world_of_run, world_tab

    results = [read_properties(run)["result"] for run in runs]
    most = max(range(len(runs)), key=lambda i: int(results[i]["modules"]))
    outline = read_outline(runs[most])
    # Its own ranges would cut the others' curves off: the viewer chooses each run's.
    outline = replace(
        outline,
        end=max(outline.end, *(int(result["frames"]) for result in results)),
        lines={name: values[:0] for name, values in outline.lines.items()},
    )
    streams, file = outline.streams(MOST_STREAMS), place / "layout.rbl"
    shown = world_tab(outline.header, world_of_run(outline.header, runs[most])[0], streams)
    run_layout(outline, shown, tab=tab).save(APPLICATION, str(file))
    _set_layout(dataset, file)


def _set_layout(dataset: Any, file: Path) -> None:
    """Make the layout in a file that in which every run opens."""
    layouts = dataset.blueprint_dataset()
    (segment,) = layouts.register([file.resolve().as_uri()], [ROWS], "replace").wait(
        REGISTER_SECONDS
    )
    dataset.set_default_blueprint_segment_id(segment)


def add_views(
    runs: Sequence[Path],
    dataset: Any,
    place: Path,
    progress: Progress | None = None,
) -> None:
    """Add the views of runs to the rows that a server has, building what is missing or old.

    A run whose view cannot be made is named on stderr and left with its row alone.

    Args:
        runs: folders of runs.
        dataset: the server's.
        place: folder for copies of views.
        progress: called with the runs that are done, and all.
    """
    for start in range(0, len(runs), TOGETHER):
        views: list[Path] = []
        for i, run in enumerate(runs[start : start + TOGETHER], start + 1):
            try:
                views.append(ready_view(run))
            except (CdmisfaError, OSError) as error:
                tell(f"{run} has no view: {error}")
            if progress is not None:
                progress(i, len(runs))
        # The rows hold the properties too, perhaps in other types: a table's column has one.
        bare = {
            _as_layer(view, place / f"view-{start + i:05d}.rrd"): view
            for i, view in enumerate(_register(dataset, views, LAYER))
        }
        for copy, reason in _register(dataset, list(bare), LAYER).items():
            tell(f"{bare[copy]} is not served: {reason}")


def _register(dataset: Any, files: Sequence[Path], layer: str) -> dict[Path, str]:
    """Add recordings to a dataset; those that the server refuses, with its reasons."""
    if not files:
        return {}
    names = {file.resolve().as_uri(): file for file in files}
    handle = dataset.register(list(names), [layer] * len(names), "replace")
    answers = handle.iter_results(REGISTER_SECONDS)
    return {names[name]: reason.splitlines()[-1] for name, _, reason in answers if reason}


def _as_layer(view: Path, out: Path) -> Path:
    """A copy of a view that leaves a run's properties to its row, and the robot's body out."""
    from replay.view.scene import (
        BODY,  # imports the package, as the layout did
        SCENE,
    )

    reader = RrdReader(str(view))
    (store,) = (s for s in reader.store_entries() if s.kind == "recording")
    kept = reader.stream(store).drop_matching(content=["/__properties/**", f"/{SCENE}/{BODY}/**"])
    kept.write_rrd(str(out), store.application_id, store.recording_id)
    return out


def _dataset_name(folder: Path) -> str:
    """A folder's name in the letters that the server takes."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "_", folder.resolve().name).strip("_.-")[:180] or "runs"


def _identity(view: Path) -> str:
    """Name of the recording in a view, "" where it cannot be read."""
    with contextlib.suppress(*REFUSALS):
        stores = RrdReader(str(view)).store_entries()
        return next((str(s.recording_id) for s in stores if s.kind == "recording"), "")
    return ""
