"""Many runs in one table: Rerun's own catalogue server over the views of a folder of runs.

A row is a run, its columns are the run's configuration and result; from there each run
is opened in its own view. Only programs on this machine can connect.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

from rerun.chunk import RrdReader

from cdmisfa.errors import CdmisfaError, UsageError
from replay.live import open_live
from replay.runlog import is_run, run_log
from replay.view import build_view
from replay.viewer import free_port, has_display, run_program

VIEW_FILE = "run.rrd"
"""Name of the view in a run's folder."""

TRIALS = "trials"
"""Folder of a sweep that holds its runs."""

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


def collect_views(runs: Sequence[Path], into: Path, progress: Progress | None = None) -> list[str]:
    """Put links to the views of runs into one folder, building views that are missing or old.

    Args:
        runs: folders of runs.
        into: an empty folder.
        progress: called with the runs that are done, and all.

    Returns:
        The name that each run's recording has, no two of them the same.

    Raises:
        LogDamagedError: a run cannot be read.
        CdmisfaError: a view cannot be written.
    """
    names: list[str] = []
    for i, run in enumerate(runs):
        view, log = run / VIEW_FILE, run_log(run)
        old = not view.is_file() or view.stat().st_mtime < log.stat().st_mtime
        name = "" if old else _identity(view)
        if not name:
            build_view(run, view)
            name = _identity(view)
        names.append(name)
        if progress is not None:
            progress(i + 1, len(runs))
    count = Counter(names)
    for i, run in enumerate(runs):
        if count[names[i]] > 1:  # the copy of a run brought its view along
            build_view(run, run / VIEW_FILE)
            names[i] = _identity(run / VIEW_FILE)
        _link(run / VIEW_FILE, into / f"{i:05d}_{run.name}.rrd")
    return names


def serve_catalogue(
    folder: Path, *, port: int | None = None, progress: Progress | None = None
) -> None:
    """Serve a folder of runs until interrupted, and open it where there is a display.

    Prints the address of their table on stderr.

    Args:
        folder: of a sweep that kept its logs, or any folder of runs.
        port: to listen at; by default a free one.
        progress: called with the views that are ready, and all.

    Raises:
        UsageError: there is no run in it.
        CdmisfaError: a view cannot be written, or the server ended with an error.
    """
    runs = runs_in(folder)
    if not runs:
        raise UsageError(f"{folder} holds no runs: sweep with --keep-logs")
    port = port or free_port()
    address = f"rerun+http://127.0.0.1:{port}"
    with tempfile.TemporaryDirectory(prefix="cdmisfa-runs-") as place:
        collect_views(runs, Path(place), progress)
        said = threading.Thread(target=_say, args=(len(runs), address), daemon=True)
        said.start()
        arguments = ["server", "--host", "127.0.0.1", "--port", str(port)]
        run_program([*arguments, "--dataset", f"{folder.resolve().name}={place}"])


def _say(count: int, address: str) -> None:
    """Say where the table of runs is, once it is served, and open it there."""
    table = table_address(address, count)
    print(f"{count} runs at {table}    look at them: rerun {table}", file=sys.stderr, flush=True)
    if has_display():
        open_live(table)


def table_address(address: str, count: int, seconds: float = 60.0) -> str:
    """Where a server's one dataset is, so that the viewer opens with its table.

    Waits until every run is in it: a viewer that has asked does not ask again.

    Args:
        address: of the server, "rerun+http://127.0.0.1:PORT".
        count: how many runs there are.
        seconds: how long to wait for them.

    Returns:
        The table's address; the server's own, from where it is one click to the table, where
        the server does not say.
    """
    # Rerun's public client of a catalogue needs DataFusion; to ask for a name it is too much.
    from rerun_bindings import CatalogClientInternal

    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            (dataset,) = CatalogClientInternal(address).datasets(include_hidden=False)
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


def _link(view: Path, link: Path) -> None:
    # A hard link: the server does not see symbolic ones.
    try:
        os.link(view, link)
    except OSError:  # on another file system
        try:
            shutil.copyfile(view, link)
        except OSError as error:
            raise CdmisfaError(f"{link} cannot be written: {error.strerror or error}") from error
