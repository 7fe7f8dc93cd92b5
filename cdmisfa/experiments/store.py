"""Trials, a row each when they end: none is computed twice, however often it is asked for.

A trial is known by a hash of everything it depends on, the code included. A folder's
rows.jsonl has a line of JSON for each; the last line of a trial counts.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

from cdmisfa.core.errors import CdmisfaError, LogDamagedError, LogWriteError
from cdmisfa.core.processes import run_all
from cdmisfa.core.untrusted import BUDGET, MAX_LIST, budget, opened_regular, parse_json
from recorder.log.files import held, make_folder, refuse_named_as_file, refuse_special, to_disk

ROWS = "rows.jsonl"
"""The rows, in a folder."""

DONE, FAILED = "done", "failed"


@cache
def code(*more: str) -> str:
    """Return the version of what a trial computes: the package's, and a hash of its sources.

    Args:
        more: further modules that decide the result: "cdmisfa/modules".
    """
    root = Path(__file__).parents[2]
    rooms = ("cdmisfa/core", "cdmisfa/features", "cdmisfa/agents", "recorder")
    files = [file for room in rooms for file in (root / room).rglob("*.py")]
    modules = ("cdmisfa/experiments/loop", "cdmisfa/experiments/trial", *more)
    files += [root / f"{module}.py" for module in modules]
    digest = hashlib.sha256()
    for file in sorted(files):
        digest.update(f"{file.relative_to(root).as_posix()}\0".encode() + file.read_bytes())
    return f"{metadata.version('cdmisfa')}+{digest.hexdigest()[:12]}"


def trial_id(*depends: Any) -> str:
    """The name of a trial: a hash of what decides its result, as JSON values."""
    text = json.dumps(depends, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:32]


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredTrial:
    """What there is to know of a trial to compute it only once.

    Attributes:
        id: hash of all it depends on.
        point: what it is a trial of.
        seed: which of the trials there.
        code: version of the code that the hash is about; workers must have the same.
        log: folder in which to keep its log, or None.
    """

    id: str
    point: Mapping[str, Any]
    seed: int
    code: str
    log: Path | None = None


Task = TypeVar("Task", bound=StoredTrial)


class TrialStore:
    """The rows of a folder, to add to; only one process at a time may.

    Attributes:
        rows: the last row of every trial, by its identity.

    Raises:
        UsageError: another process holds the folder, or its rows are no file.
        LogDamagedError: a line is not a row.
        LogWriteError: the disk does not take it, here or in any later call.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / ROWS
        with contextlib.ExitStack() as opened:
            with self._telling():
                make_folder(folder)
            opened.enter_context(held(folder))
            refuse_special(self._path)
            self._of_logs: dict[str, str] = {}
            self.rows, size = _read(self._path, self._of_logs)
            with self._telling():
                # Unbuffered: what a disk refused once is not tried again when it is closed.
                self._file = opened.enter_context(open(self._path, "ab", buffering=0))
                self._file.truncate(size)  # a kill cut the rest short
                to_disk(folder)
            self._opened = opened.pop_all()

    def add(self, row: Mapping[str, Any]) -> None:
        """Add the row of a trial: its `id`, its `status`, the `point` it is at, and more."""
        line = json.dumps(row, separators=(",", ":"))
        data = memoryview(line.encode() + b"\n")
        with self._telling():
            while data:
                data = data[self._file.write(data) :]
        _put(self.rows, self._of_logs, json.loads(line))

    def close(self) -> None:
        """Let the disk have the rows, and let go of the folder."""
        with self._opened, self._telling():
            os.fsync(self._file.fileno())

    @contextlib.contextmanager
    def _telling(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise LogWriteError(f"{self._path} cannot be written: {error.strerror}") from error


def read_rows(folder: Path) -> Iterator[dict[str, Any]]:
    """The last row of every trial in a folder, in the order of their first rows.

    A last line that a kill cut short does not count.

    Raises:
        UsageError: they are in no regular file.
        LogDamagedError: a line is not a row, or together they take more memory than `budget`.
    """
    yield from _read(folder / ROWS)[0].values()


def _put(rows: dict[str, dict[str, Any]], of_logs: dict[str, str], row: dict[str, Any]) -> None:
    """Take the row of a trial in; that of another one whose log it replaced counts no more.

    Args:
        rows: by the identities of trials.
        of_logs: the identity of the trial that each log is of, by the log's name.
        row: the next one.
    """
    if row.get("run"):
        name = Path(row["run"]).name
        if of_logs.get(name, row["id"]) != row["id"]:
            rows.pop(of_logs[name], None)
        of_logs[name] = row["id"]
    rows[row["id"]] = row


def _read(
    path: Path, of_logs: dict[str, str] | None = None
) -> tuple[dict[str, dict[str, Any]], int]:
    """The last row of every trial, by its identity, and the bytes of whole lines."""
    of_logs = {} if of_logs is None else of_logs
    rows: dict[str, dict[str, Any]] = {}
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
                    checked = {"status": row["status"], "point": dict(row["point"])}
                    _put(rows, of_logs, {**row, "id": row["id"], **checked})
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
    return rows, size


@dataclass(frozen=True, slots=True)
class SweepReport:
    """What a sweep came to.

    Attributes:
        trials: how many were asked for.
        skipped: how many of them were finished before.
        computed: how many finished now.
        failed: rows of those that failed, now or before.
    """

    folder: Path
    trials: int
    skipped: int
    computed: int
    failed: tuple[Mapping[str, Any], ...] = field(default=())


def run_trials(
    trials: Sequence[Task],
    folder: Path,
    compute: Callable[[Task], Mapping[str, Any]],
    *,
    jobs: int = 1,
    scheduler: str | None = None,
    retry_failed: bool = False,
    begin: Callable[[Sequence[Task]], None] = lambda missing: None,
    progress: Callable[[int, int, int], None] = lambda finished, failed, total: None,
) -> SweepReport:
    """Compute the trials that have no row in a folder yet.

    Args:
        trials: all that are asked for.
        folder: where the rows are; made where it does not exist.
        compute: a trial's result, or under "error" why there is none; importable by workers.
        jobs: local processes.
        scheduler: address of a dask scheduler, whose workers compute instead.
        retry_failed: compute trials again that failed before.
        begin: called with those to be computed, once the folder is held and before the first.
        progress: called with the trials finished, failed, and asked for.

    Raises:
        UsageError: another process holds the folder.
        WorkersError: a worker died, or no scheduler answers.
    """
    refuse_special(folder)
    refuse_named_as_file(folder)

    def is_missing(trial: Task) -> bool:
        row = store.rows.get(trial.id)
        if row is None or (retry_failed and row["status"] == FAILED):
            return True
        return row["status"] == DONE and trial.log is not None and not trial.log.exists()

    with contextlib.closing(TrialStore(folder)) as store:
        missing = [trial for trial in trials if is_missing(trial)]
        begin(missing)
        skipped = len(trials) - len(missing)
        left = {trial.id for trial in missing}
        failed = sum(store.rows[t.id]["status"] == FAILED for t in trials if t.id not in left)
        computed = run_all(compute, missing, jobs=jobs, scheduler=scheduler)
        for finished, (index, result) in enumerate(computed, start=skipped + 1):
            row = _row(missing[index], result)
            store.add(row)
            failed += row["status"] == FAILED
            progress(finished, failed, len(trials))
        rows = store.rows
    return SweepReport(
        folder=folder,
        trials=len(trials),
        skipped=skipped,
        computed=sum(rows[trial.id]["status"] == DONE for trial in missing),
        failed=tuple(rows[t.id] for t in trials if rows[t.id]["status"] == FAILED),
    )


def answer(
    trial: Task, version: str, compute: Callable[[Task], Mapping[str, Any]]
) -> Mapping[str, Any]:
    """What a trial came to, or under "error" why it did not.

    Args:
        trial: the trial.
        version: of the code that is here.
        compute: how; whatever it raises is the answer.

    Raises:
        LogWriteError: the disk does not take what it writes, so it would take no other's either.
    """
    if trial.code != version:
        return {"error": f"the worker has cdmisfa {version}, not {trial.code}: install the same"}
    try:
        return compute(trial)
    except LogWriteError:
        raise
    except CdmisfaError as error:
        return {"error": str(error), "exit_code": error.exit_code}
    except Exception as error:
        # Whatever breaks in one trial must not end a sweep of thousands.
        return {"error": f"{type(error).__name__}: {error}"}


def _row(trial: StoredTrial, result: Mapping[str, Any]) -> dict[str, Any]:
    failed = "error" in result
    return {
        "id": trial.id,
        "status": FAILED if failed else DONE,
        "point": dict(trial.point),
        "seed": trial.seed,
        "code": trial.code,
        "run": str(trial.log) if trial.log is not None and not failed else None,
        **(result if failed else {"result": result}),
    }
