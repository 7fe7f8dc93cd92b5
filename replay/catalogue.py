"""Many runs in one table: Rerun's own catalogue server over a folder of runs.

A row is a run, its columns are the run's configuration and result; from there each run
is opened in its own view. The rows come first, from the manifests; the views, which are
larger and may have to be built, follow as a second layer of the same recordings. Only
programs on this machine can connect.
"""

from __future__ import annotations

import contextlib
import re
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rerun.chunk import RrdReader

from cdmisfa.errors import CdmisfaError, UsageError
from replay.properties import run_identity, write_row
from replay.runlog import is_run, run_log
from replay.viewer import free_port, has_display, run_program

VIEW_FILE = "run.rrd"
"""Name of the view in a run's folder."""

TRIALS = "trials"
"""Folder of a sweep that holds its runs."""

LAYER = "view"
"""Name of the layer of views, beside that of the rows."""

TOGETHER = 100
"""Views that are registered at once: each time the server goes over all that it has."""

REGISTER_SECONDS = 300
"""Longest wait for the server to read the views that are registered at once."""

LAST_SECONDS = 5.0
"""Longest wait, at the end, for the view that is being built."""

Progress = Callable[[int, int], None]


def runs_in(folder: Path) -> list[Path]:
    """The folders of runs in a folder or in its `trials`; none where it is itself a run.

    Args:
        folder: of a sweep, or any other.
    """
    folder = Path(folder)
    if not folder.is_dir() or is_run(folder):
        return []
    places = [p for root in (folder, folder / TRIALS) if root.is_dir() for p in root.iterdir()]
    return sorted(p for p in places if p.is_dir() and is_run(p))


def ready_view(run: Path) -> Path:
    """The view of a run; built where it is missing, older than the log, or of another run.

    Raises:
        LogDamagedError: the run cannot be read.
        CdmisfaError: the view cannot be written.
    """
    from replay.view import build_view  # only where a view is missing

    view, log = run / VIEW_FILE, run_log(run)
    old = not view.is_file() or view.stat().st_mtime < log.stat().st_mtime
    if old or _identity(view) != run_identity(run):  # the copy of a run brings its view along
        build_view(run, view)
    return view


def serve_catalogue(
    folder: Path, *, port: int | None = None, progress: Progress | None = None
) -> None:
    """Serve a folder of runs until interrupted, and open it where there is a display.

    Prints the address of their table on stderr as soon as it is there; the views that the
    rows lead to follow. A run whose view cannot be made is named on stderr.

    Args:
        folder: of a sweep that kept its logs, or any folder of runs.
        port: to listen at; by default a free one.
        progress: called with the views that are ready, and all.

    Raises:
        UsageError: there is no run in it.
        LogDamagedError: a run without a manifest cannot be read.
        CdmisfaError: the server ended with an error.
    """
    runs = runs_in(folder)
    if not runs:
        raise UsageError(f"{folder} holds no runs: sweep with --keep-logs")
    port, ended = port or free_port(), threading.Event()
    address = f"rerun+http://127.0.0.1:{port}"
    with tempfile.TemporaryDirectory(prefix="cdmisfa-runs-") as place:
        for i, run in enumerate(runs):
            write_row(run, Path(place) / f"{i:05d}.rrd")
        follow = threading.Thread(
            target=_follow, args=(runs, address, progress, ended), daemon=True
        )
        follow.start()
        arguments = ["server", "--host", "127.0.0.1", "--port", str(port)]
        try:
            run_program([*arguments, "--dataset", f"{_dataset_name(folder)}={place}"])
        finally:
            ended.set()
            follow.join(LAST_SECONDS)


def _follow(
    runs: Sequence[Path], address: str, progress: Progress | None, ended: threading.Event
) -> None:
    """Say where the table of runs is, once it is served, open it there, and add the views."""
    table = table_address(address, len(runs), ended=ended)
    if ended.is_set():
        return
    print(
        f"{len(runs)} runs at {table}    look at them: rerun {table}", file=sys.stderr, flush=True
    )
    if has_display():
        from replay.live import open_live

        open_live(table)
    add_views(runs, address, progress, ended)


def add_views(
    runs: Sequence[Path],
    address: str,
    progress: Progress | None = None,
    ended: threading.Event | None = None,
) -> None:
    """Add the views of runs to the rows that a server has, building what is missing or old.

    A run whose view cannot be made is named on stderr and left with its row alone.

    Args:
        runs: folders of runs.
        address: of the server, "rerun+http://127.0.0.1:PORT".
        progress: called with the runs that are done, and all.
        ended: set once the server has ended.
    """
    for start in range(0, len(runs), TOGETHER):
        views: list[Path] = []
        for i, run in enumerate(runs[start : start + TOGETHER], start + 1):
            if ended is not None and ended.is_set():
                return
            try:
                views.append(ready_view(run))
            except (CdmisfaError, OSError) as error:
                print(f"{run} has no view: {error}", file=sys.stderr, flush=True)
            if progress is not None:
                progress(i, len(runs))
        try:
            _register(address, views)
        except (OSError, RuntimeError, ValueError) as error:
            if ended is None or not ended.wait(1.0):  # the server goes first
                print(f"views are not served: {error}", file=sys.stderr, flush=True)


def _register(address: str, views: Sequence[Path]) -> None:
    if not views:
        return
    names, layers = [view.resolve().as_uri() for view in views], [LAYER] * len(views)
    _dataset(address).register(names, layers, "replace").wait(REGISTER_SECONDS)


def _dataset_name(folder: Path) -> str:
    """A folder's name in the letters that the server takes."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "_", folder.resolve().name).strip("_.-") or "runs"


def _dataset(address: str) -> Any:
    """A server's one dataset."""
    # Rerun's public client of a catalogue needs DataFusion; to ask for a name it is too much.
    from rerun_bindings import CatalogClientInternal

    (dataset,) = CatalogClientInternal(address).datasets(include_hidden=False)
    return dataset


def table_address(
    address: str, count: int, seconds: float = 60.0, ended: threading.Event | None = None
) -> str:
    """Where a server's one dataset is, so that the viewer opens with its table.

    Waits until every run is in it: a viewer that has asked does not ask again.

    Args:
        address: of the server, "rerun+http://127.0.0.1:PORT".
        count: how many runs there are.
        seconds: how long to wait for them.
        ended: set once the server has ended.

    Returns:
        The table's address; the server's own, from where it is one click to the table, where
        the server does not say.
    """
    end = time.monotonic() + seconds
    while time.monotonic() < end and not (ended is not None and ended.is_set()):
        try:
            dataset = _dataset(address)
            if len(dataset.segment_ids()) >= count:
                return f"{address}/entry/{dataset.entry_details().id}"
        except (ConnectionError, OSError, RuntimeError, ValueError):
            pass  # it does not listen yet
        except (AttributeError, TypeError):  # another version of Rerun
            break
        time.sleep(0.05)
    return address


def _identity(view: Path) -> str:
    """Name of the recording in a view, "" where it cannot be read."""
    with contextlib.suppress(RuntimeError, ValueError, OSError):
        return str(RrdReader(str(view)).recordings()[0].recording_id)
    return ""
