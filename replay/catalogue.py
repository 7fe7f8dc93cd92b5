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
    for i, run in enumerate(runs):
        view, log = run / VIEW_FILE, run_log(run)
        if not view.is_file() or view.stat().st_mtime < log.stat().st_mtime or not _identity(view):
            build_view(run, view)
        if progress is not None:
            progress(i + 1, len(runs))
    names = [_identity(run / VIEW_FILE) for run in runs]
    for i, run in enumerate(runs):
        if names.count(names[i]) > 1:  # the copy of a run brought its view along
            build_view(run, run / VIEW_FILE)
            names[i] = _identity(run / VIEW_FILE)
        _link(run / VIEW_FILE, into / f"{i:05d}_{run.name}.rrd")
    return names


def serve_catalogue(
    folder: Path, *, port: int | None = None, progress: Progress | None = None
) -> None:
    """Serve a folder of runs until interrupted, and open it where there is a display.

    Prints the address on stderr.

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
        print(f"{len(runs)} runs at {address}    look at them: rerun {address}", file=sys.stderr)
        if has_display():
            open_live(address)
        arguments = ["server", "--host", "127.0.0.1", "--port", str(port)]
        run_program([*arguments, "--dataset", f"{folder.resolve().name}={place}"])


def _identity(view: Path) -> str:
    """Name of the recording in a view, "" where it cannot be read."""
    with contextlib.suppress(RuntimeError, ValueError, OSError):
        return str(RrdReader(str(view)).recordings()[0].recording_id)
    return ""


def _link(view: Path, link: Path) -> None:
    try:
        os.symlink(view.resolve(), link)
    except OSError:  # not everybody may make links on Windows
        try:
            shutil.copyfile(view, link)
        except OSError as error:
            raise CdmisfaError(f"{link} cannot be written: {error.strerror or error}") from error
