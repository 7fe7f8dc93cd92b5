"""Trials that ended, a row each: none is computed twice, however often it is asked for.

A trial is known by a hash of everything it depends on, the code included. A folder's
rows.jsonl has a line of JSON for each; the last line of a trial counts.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, BinaryIO

from cdmisfa.core.errors import LogDamagedError
from recorder.log.folder import held

ROWS = "rows.jsonl"
"""The rows, in a folder."""

DONE, FAILED = "done", "failed"


@cache
def code() -> str:
    """Version of what a trial computes: the package's, and a hash of learner and recorder."""
    root = Path(__file__).parents[2]
    rooms = ("cdmisfa/core", "cdmisfa/features", "cdmisfa/agents", "recorder")
    files = [file for room in rooms for file in (root / room).rglob("*.py")]
    files += [root / "cdmisfa/experiments" / f"{name}.py" for name in ("loop", "trial")]
    digest = hashlib.sha256()
    for file in sorted(files):
        digest.update(f"{file.relative_to(root).as_posix()}\0".encode() + file.read_bytes())
    return f"{metadata.version('cdmisfa')}+{digest.hexdigest()[:12]}"


def identity(*depends: Any) -> str:
    """The name of a trial: a hash of what decides its result, as JSON values."""
    text = json.dumps(depends, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:32]


class TrialStore:
    """The rows of a folder, to add to; only one process at a time may.

    Attributes:
        rows: the last row of every trial, by its identity.

    Raises:
        UsageError: another process holds the folder.
        LogDamagedError: a line is not a row.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        with contextlib.ExitStack() as opened:
            opened.enter_context(held(folder))
            self._file: BinaryIO = opened.enter_context(open(folder / ROWS, "a+b"))
            self._file.seek(0)
            self._file.truncate(self._file.read().rfind(b"\n") + 1)  # a kill cut the rest short
            self.rows = {row["id"]: row for row in read_rows(folder)}
            self._opened = opened.pop_all()

    def needs_computing(self, trial: str, kept: Path | None = None, *, retry: bool = False) -> bool:
        """Whether a trial has no row yet, or what was `kept` of it beside its row is gone.

        One that has failed needs computing only with `retry`.
        """
        row = self.rows.get(trial)
        if row is None or (retry and row["status"] == FAILED):
            return True
        return row["status"] == DONE and kept is not None and not kept.exists()

    def add(self, row: Mapping[str, Any]) -> None:
        """Add the row of a trial: its `id`, its `status`, the `point` it is at, and more."""
        line = json.dumps(row, separators=(",", ":"))
        self._file.write(line.encode() + b"\n")
        self._file.flush()
        self.rows[row["id"]] = json.loads(line)

    def close(self) -> None:
        """Let go of the folder."""
        self._opened.close()


def read_rows(folder: Path) -> Iterator[dict[str, Any]]:
    """The last row of every trial in a folder, in the order of their first rows.

    A last line that a kill cut short does not count.

    Raises:
        LogDamagedError: a line is not a row.
    """
    path = folder / ROWS
    rows: dict[str, dict[str, Any]] = {}
    data = path.read_bytes() if path.is_file() else b""
    for number, line in enumerate(data[: data.rfind(b"\n") + 1].splitlines(), start=1):
        try:
            row = json.loads(line)
            rows[row["id"]] = {**row, "status": row["status"], "point": dict(row["point"])}
        except (ValueError, KeyError, TypeError) as error:
            raise LogDamagedError(
                f"{path} line {number} is no trial's row: remove the line"
            ) from error
    yield from rows.values()
