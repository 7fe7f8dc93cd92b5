"""Many runs side by side: a table of what they came to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from replay.runs.compare import Difference, compare
from replay.runs.log import run_log
from replay.runs.outline import Outline, read_outline


@dataclass(frozen=True, slots=True)
class Row:
    """A run in a table of runs.

    Attributes:
        name: of the run's folder.
        outline: the run in short.
        difference: where its signals first differ from the first run's; None where every
            bit is the same, as for the first run itself.
    """

    name: str
    outline: Outline
    difference: Difference | None

    def as_json(self) -> dict[str, Any]:
        """The row as JSON values."""
        streams = self.outline.names()
        return {
            "run": self.name,
            "seed": self.outline.header.manifest.get("seed"),
            "iterations": self.outline.iterations,
            "modules": [streams[saved.stream] for saved in self.outline.saved],
            "first_difference": None if self.difference is None else self.difference.as_json(),
        }

    def cells(self) -> tuple[str, ...]:
        """The row as words, in the order of `HEAD`."""
        found = self.as_json()
        same = "identical, bit for bit" if self.difference is None else str(self.difference)
        learned = ", ".join(found["modules"]) or "none"
        return self.name, str(found["seed"]), str(found["iterations"]), learned, same


HEAD = ("run", "seed", "iterations", "modules", "against the first run")


def survey(runs: Sequence[Path]) -> tuple[Row, ...]:
    """What each run came to, and where it first differs from the first one.

    Raises:
        UsageError: one of them is no run.
        LogDamagedError: one of them cannot be read.
    """
    rows: list[Row] = []
    for run in runs:
        outline, found = read_outline(run), None
        if rows:
            found = compare(runs[0], run, (rows[0].outline.header, outline.header))
        rows.append(Row(_name(run), outline, found))
    return tuple(rows)


def _name(run: Path) -> str:
    return run_log(run).resolve().parent.name
