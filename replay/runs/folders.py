"""Folders of runs: names of their files, and the runs in a folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from cdmisfa.core.untrusted import MAX_LIST, check_regular, read_json
from recorder.log.files import partial_path
from recorder.mcap.reader import LogReader
from replay.storage.paths import no_such

# Name of the log in a run's folder.
RUN_FILE = "run.mcap"

# Name of the file with the command, the source and the result of a run.
RUN_JSON = "run.json"

# Name of the file of the frozen modules.
MODULES_FILE = "modules.npz"

# Name of the view.
VIEW_FILE = "run.rrd"

# Name of the report.
REPORT_FILE = "report.html"

# Name of the metadata record that makes a log that of a run.
RUN_METADATA = "cdmisfa.run"

# Name of the metadata record of a finished run; see `final_record`.
FINAL_METADATA = "cdmisfa.final"

# Name of the file with the trials that a sweep was last asked for.
REQUEST = "sweep.json"


def run_log(path: Path) -> Path:
    """Return the log of a run, given its folder or the log itself; else its partial log.

    Raises:
        UsageError: there is no log, or it is not a regular file.
    """
    path = Path(path)
    whole = path / RUN_FILE if path.is_dir() else path
    for candidate in (whole, partial_path(whole)):
        if candidate.exists() and not candidate.is_dir():
            check_regular(candidate)
            return candidate
    if path.is_dir():
        raise UsageError(f"{path} is not a run (no {RUN_FILE}): name one that cdmisfa learn wrote")
    raise no_such(path, remedy=f"name the folder of a run or its {RUN_FILE}")


def is_run(path: Path) -> bool:
    """Return whether a folder or a log is that of a run.

    Raises:
        UsageError: it does not exist.
        LogDamagedError: the log is damaged, or another kind of file.
    """
    path = Path(path)
    if path.is_dir():
        return any(p.is_file() for p in (path / RUN_FILE, partial_path(path / RUN_FILE)))
    with LogReader(run_log(path)) as reader:
        return any(record.name == RUN_METADATA for record in reader.metadata)


def read_run_json(folder: Path) -> Mapping[str, Any]:
    """Return the run.json of a run; empty if it is missing or cannot be read."""
    try:
        document = read_json(folder / RUN_JSON, "learn again", limit=MAX_LIST)
    except CdmisfaError:
        return {}
    return document if isinstance(document, Mapping) else {}


def runs_in(folder: Path) -> list[Path]:
    """Return the folders of runs in a folder; none where it is itself a run."""
    folder = Path(folder)
    if not folder.is_dir() or is_run(folder):
        return []
    return sorted(p for p in folder.iterdir() if p.is_dir() and is_run(p))


def read_request(folder: Path) -> list[tuple[str, dict[str, Any]]]:
    """Return id and point of the trials that a sweep was last asked for, in the order of its grid.

    Raises:
        UsageError: the folder is not a sweep, or the file is too large.
        LogDamagedError: it is damaged, or cannot be read.
    """
    path, remedy = folder / REQUEST, "run the sweep again to write it"
    if not path.exists():
        raise UsageError(f"{folder} is not a sweep: name a folder that cdmisfa sweep -o wrote")
    request = read_json(path, remedy, limit=MAX_LIST)
    try:
        return [(str(trial["id"]), dict(trial["point"])) for trial in request["trials"]]
    except (ValueError, KeyError, TypeError) as error:
        raise LogDamagedError(f"{path} is damaged: {remedy}") from error
