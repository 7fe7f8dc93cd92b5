"""Store of trials: a row for each trial that has ended, so that none is computed twice.

A hash of everything that the result depends on, including the code, identifies a trial. The file
rows.jsonl of a folder has one line of JSON for each ended trial; a later line replaces an earlier
one of the same trial.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from cdmisfa.core.errors import CdmisfaError, LogDamagedError, LogWriteError
from cdmisfa.core.processes import run_all
from cdmisfa.core.untrusted import BUDGET, MAX_LIST, budget, opened_regular, parse_json
from recorder.log.files import (
    locked_folder,
    make_folder,
    refuse_named_as_file,
    refuse_special,
    to_disk,
    writing,
)

# Name of the file with the rows.
ROWS = "rows.jsonl"

DONE, FAILED = "done", "failed"

# Row of an ended trial: its `id`, `status`, `point`, `seed`, `code`, and `result` or `error`.
Row = dict[str, Any]


@cache
def code(*more: str) -> str:
    """Return the version of the code that computes trials: of the package, and of source files.

    Args:
        more: further modules on which the result depends, such as "cdmisfa/modules".
    """
    root = Path(__file__).parents[2]
    folders = ("cdmisfa/core", "cdmisfa/features", "cdmisfa/agents", "recorder")
    files = [file for folder in folders for file in (root / folder).rglob("*.py")]
    modules = ("cdmisfa/experiments/loop", "cdmisfa/experiments/trial", *more)
    files += [root / f"{module}.py" for module in modules]
    digest = hashlib.sha256()
    for file in sorted(files):
        digest.update(f"{file.relative_to(root).as_posix()}\0".encode() + file.read_bytes())
    return f"{metadata.version('cdmisfa')}+{digest.hexdigest()[:12]}"


@dataclass(frozen=True, slots=True)
class PlannedTrial:
    """A trial that can be computed in any process, and its identity.

    Attributes:
        id: hash of everything that the result depends on.
        call: computes the result, a mapping of JSON values; it is pickled for workers.
        point: the settings that differ between trials.
        seed: seed of the trial.
        code: version of the code; a worker must have the same.
        modules: see `code`.
        log: file that the trial writes, or None.
    """

    id: str
    call: Callable[[], Mapping[str, Any]]
    point: Mapping[str, Any]
    seed: int
    code: str
    modules: tuple[str, ...]
    log: Path | None


def make_trial(
    call: Callable[[], Mapping[str, Any]],
    *depends: Any,
    point: Mapping[str, Any],
    seed: int = 0,
    modules: tuple[str, ...] = (),
    log: Path | None = None,
) -> PlannedTrial:
    """Return a trial; the JSON values `depends` and the version of the code identify it."""
    version = code(*modules)
    text = json.dumps([*depends, version], sort_keys=True, separators=(",", ":"))
    number = hashlib.sha256(text.encode()).hexdigest()[:32]
    return PlannedTrial(number, call, point, seed, version, modules, log)


def compute(trial: PlannedTrial) -> Mapping[str, Any]:
    """Return the result of a trial; {"error": message} if it failed.

    Raises:
        LogWriteError: a file cannot be written; then other trials would fail too.
    """
    version = code(*trial.modules)
    if trial.code != version:
        return {"error": f"the worker has cdmisfa {version}, not {trial.code}: install the same"}
    try:
        return trial.call()
    except LogWriteError:
        raise
    except CdmisfaError as error:
        return {"error": str(error), "exit_code": error.exit_code}
    except Exception as error:  # one trial must not end a sweep of thousands
        return {"error": f"{type(error).__name__}: {error}"}


@dataclass(frozen=True, slots=True)
class SweepReport:
    """Outcome of computing trials.

    Attributes:
        folder: folder of the rows.
        trials: number of requested trials.
        skipped: number of trials that had finished before.
        computed: number of trials that finished now.
        failed: rows of the failed trials, now or before.
    """

    folder: Path
    trials: int
    skipped: int
    computed: int
    failed: tuple[Row, ...]


def run_trials(
    trials: Sequence[PlannedTrial],
    folder: Path,
    *,
    jobs: int = 1,
    scheduler: str | None = None,
    retry_failed: bool = False,
    begin: Callable[[Sequence[PlannedTrial]], None] = lambda missing: None,
    progress: Callable[[int, int, int], None] = lambda finished, failed, total: None,
) -> SweepReport:
    """Compute the trials that have no row in a folder yet.

    Args:
        trials: all requested trials.
        folder: folder of the rows; it is created if missing.
        jobs: number of local processes.
        scheduler: address of a dask scheduler whose workers compute instead.
        retry_failed: True to compute failed trials again.
        begin: called with the missing trials after the folder is locked.
        progress: called with the numbers of finished, failed and requested trials.

    Raises:
        UsageError: another process uses the folder.
        LogDamagedError: a line of the rows is damaged.
        LogWriteError: a row cannot be written.
        WorkersError: a worker died.
    """
    path = folder / ROWS
    refuse_named_as_file(folder)
    refuse_special(folder, path)

    def is_missing(trial: PlannedTrial) -> bool:
        row = rows.get(trial.id)
        if row is None or (retry_failed and row["status"] == FAILED):
            return True
        return row["status"] == DONE and trial.log is not None and not trial.log.exists()

    with contextlib.ExitStack() as stack:
        with writing(path):
            make_folder(folder)
        stack.enter_context(locked_folder(folder))
        rows, size = _read(path)
        with writing(path):
            # Unbuffered: closing a buffered file would repeat a write that the disk refused.
            file = stack.enter_context(open(path, "ab", buffering=0))
            file.truncate(size)  # drop the partial line of a killed process
            to_disk(folder)
        missing = [trial for trial in trials if is_missing(trial)]
        begin(missing)
        skipped, done = len(trials) - len(missing), 0
        pending = {trial.id for trial in missing}
        failed = sum(rows[t.id]["status"] == FAILED for t in trials if t.id not in pending)
        computed = run_all(compute, missing, jobs=jobs, scheduler=scheduler)
        for finished, (index, result) in enumerate(computed, start=skipped + 1):
            trial, broke = missing[index], "error" in result
            row = {
                "id": trial.id,
                "status": FAILED if broke else DONE,
                "point": dict(trial.point),
                "seed": trial.seed,
                "code": trial.code,
                "run": str(trial.log) if trial.log is not None and not broke else None,
                **(result if broke else {"result": result}),
            }
            data = memoryview(json.dumps(row, separators=(",", ":")).encode() + b"\n")
            with writing(path):
                while data:
                    data = data[file.write(data) :]
            rows[row["id"]] = row
            failed, done = failed + broke, done + (not broke)
            progress(finished, failed, len(trials))
        with writing(path):
            os.fsync(file.fileno())
    failures = tuple(rows[t.id] for t in trials if rows[t.id]["status"] == FAILED)
    return SweepReport(folder, len(trials), skipped, done, failures)


def read_trial_rows(folder: Path) -> Iterator[Row]:
    """Yield the last row of every trial in a folder, without a partial last line.

    Raises:
        UsageError: rows.jsonl is not a regular file.
        LogDamagedError: a line is damaged, or the rows take more memory than `budget`.
    """
    yield from _read(folder / ROWS)[0].values()


def _read(path: Path) -> tuple[dict[str, Row], int]:
    """Return the last row of every trial by its id, and the number of bytes of complete lines."""
    rows: dict[str, Row] = {}
    size = 0
    if not path.exists():
        return rows, size
    try:
        with budget(), opened_regular(path) as file:
            lines = iter(lambda: file.readline(MAX_LIST + 1), b"")
            for number, line in enumerate(lines, start=1):
                if not line.endswith(b"\n") and len(line) <= MAX_LIST:
                    break
                try:
                    row = parse_json(line, MAX_LIST)
                    row = {**row, "status": row["status"], "point": dict(row["point"])}
                    rows.pop(row["id"], None)  # so that the order is that of the last rows
                    rows[row["id"]] = row
                except (ValueError, KeyError, TypeError) as error:
                    raise LogDamagedError(f"{path} line {number} is damaged: remove it") from error
                size += len(line)
    except MemoryError:
        rows.clear()
        raise LogDamagedError(
            f"{path}: its rows take more than {BUDGET >> 20} MiB of memory, the limit: "
            "split the grid over several folders"
        ) from None
    # A trial whose file was written again by another trial is no longer finished.
    writers = {Path(row["run"]).name: row["id"] for row in rows.values() if row.get("run")}
    current = {
        row["id"]: row
        for row in rows.values()
        if not row.get("run") or writers[Path(row["run"]).name] == row["id"]
    }
    return current, size
