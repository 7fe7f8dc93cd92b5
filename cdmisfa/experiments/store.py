"""Trials, and a row for each when it ends: no trial is computed twice.

A trial is identified by a hash of everything it depends on, the code included. The file rows.jsonl
of a folder has a line of JSON for each trial; the last line of a trial counts.
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
from cdmisfa.experiments.documents import writing
from recorder.log.files import held, make_folder, refuse_named_as_file, refuse_special, to_disk

# The file of the rows in a folder.
ROWS = "rows.jsonl"

DONE, FAILED = "done", "failed"

# A finished trial: its `id`, `status`, `point`, `seed`, `code`, and `result` or `error`.
Row = dict[str, Any]


@cache
def code(*more: str) -> str:
    """Return the version of the code that computes trials: the package's, and a hash of sources.

    Args:
        more: further modules that decide the result, as "cdmisfa/modules".
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
class Trial:
    """A trial: what identifies it, and the call that computes it in any process.

    Attributes:
        id: hash of everything the result depends on.
        call: computes the result, a mapping of JSON values; pickled for workers.
        point: the settings that differ from trial to trial.
        seed: the seed.
        code: the version of the code; a worker must have the same.
        modules: see `code`.
        log: a file that the trial writes, or None.
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
) -> Trial:
    """Return a trial, identified by the JSON values that its result depends on, and by the code."""
    version = code(*modules)
    text = json.dumps([*depends, version], sort_keys=True, separators=(",", ":"))
    number = hashlib.sha256(text.encode()).hexdigest()[:32]
    return Trial(number, call, point, seed, version, modules, log)


def compute(trial: Trial) -> Mapping[str, Any]:
    """Return the result of a trial, or under "error" why there is none.

    Raises:
        LogWriteError: the disk refuses a file, and would refuse the files of other trials too.
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
        trials: the number of trials that were asked for.
        skipped: the number that were finished before.
        computed: the number that finished now.
        failed: rows of failed trials, now or before.
    """

    folder: Path
    trials: int
    skipped: int
    computed: int
    failed: tuple[Row, ...]


def run_trials(
    trials: Sequence[Trial],
    folder: Path,
    *,
    jobs: int = 1,
    scheduler: str | None = None,
    retry_failed: bool = False,
    begin: Callable[[Sequence[Trial]], None] = lambda missing: None,
    progress: Callable[[int, int, int], None] = lambda finished, failed, total: None,
) -> SweepReport:
    """Compute the trials that have no row in a folder yet.

    Args:
        trials: all trials that are asked for.
        folder: the folder of the rows; made where it does not exist.
        jobs: local processes.
        scheduler: address of a dask scheduler, whose workers compute instead.
        retry_failed: compute trials again that failed before.
        begin: called with the missing trials, once the folder is locked and before the first.
        progress: called with the trials finished, failed, and asked for.

    Raises:
        UsageError: another process works in the folder.
        LogDamagedError: a line of the rows is none.
        LogWriteError: a row cannot be written.
        WorkersError: a worker died, or no scheduler answers.
    """
    path = folder / ROWS
    refuse_named_as_file(folder)
    refuse_special(folder, path)

    def is_missing(trial: Trial) -> bool:
        row = rows.get(trial.id)
        if row is None or (retry_failed and row["status"] == FAILED):
            return True
        return row["status"] == DONE and trial.log is not None and not trial.log.exists()

    with contextlib.ExitStack() as opened:
        with writing(path):
            make_folder(folder)
        opened.enter_context(held(folder))
        rows, size = _read(path)
        with writing(path):
            # Unbuffered, so that closing does not repeat a write that the disk refused.
            file = opened.enter_context(open(path, "ab", buffering=0))
            file.truncate(size)  # a kill cut the rest short
            to_disk(folder)
        missing = [trial for trial in trials if is_missing(trial)]
        begin(missing)
        skipped, done = len(trials) - len(missing), 0
        left = {trial.id for trial in missing}
        failed = sum(rows[t.id]["status"] == FAILED for t in trials if t.id not in left)
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


def read_rows(folder: Path) -> Iterator[Row]:
    """Yield the last row of every trial in a folder.

    A last line that a kill cut short does not count.

    Raises:
        UsageError: the file is no regular file.
        LogDamagedError: a line is no row, or together they take more memory than `budget`.
    """
    yield from _read(folder / ROWS)[0].values()


def _read(path: Path) -> tuple[dict[str, Row], int]:
    """Return the last row of every trial by its identity, and the bytes of whole lines."""
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
                    rows.pop(row["id"], None)  # the order is that of the last rows
                    rows[row["id"]] = row
                except (ValueError, KeyError, TypeError) as error:
                    raise LogDamagedError(
                        f"{path} line {number} is no trial's row: remove the line"
                    ) from error
                size += len(line)
    except MemoryError:
        rows.clear()
        raise LogDamagedError(
            f"{path}: its rows take more than {BUDGET >> 20} MiB of memory, the limit: "
            "split the grid over several folders"
        ) from None
    # A trial whose file another trial has written since is no longer finished.
    writers = {Path(row["run"]).name: row["id"] for row in rows.values() if row.get("run")}
    current = {
        row["id"]: row
        for row in rows.values()
        if not row.get("run") or writers[Path(row["run"]).name] == row["id"]
    }
    return current, size
