"""What happened in a run, in short: read once before it is shown or drawn."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.signals import NO_STATE, SIGNALS
from replay.runs.columns import Blocks, SignalColumns, told
from replay.runs.log import RunHeader, read_header
from replay.runs.stretches import read_columns

LINES = (
    *("eta", "eta_dot", "reward", "curiosity", "expert", "xi", "share", "epsilon"),
    *("change", "tested", "fitted", "learning_error", "interest"),
)
"""Signals whose values are kept for every iteration, to choose ranges from."""


@dataclass(frozen=True, slots=True)
class Saved:
    """What the record of the iteration at whose end a module was saved says, by its names."""

    module: int
    stream: int
    iteration: int
    t: int
    policy: tuple[int, ...]
    eta: tuple[float, ...]
    eta_dot: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Phase:
    """The blocks in which one abstraction was learned.

    Attributes:
        novel: how many of them the gate let through.
        visits: (S,) how many of them were of each stream.
    """

    module: int
    blocks: int
    novel: int
    visits: NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Outline:
    """A run in short.

    Attributes:
        iterations: number of records; `frames` those watched.
        blocks: of all records.
        end: the frame after the last one; there may be more before it than were watched.
        tau: frames of a block.
        outputs: of an abstraction.
        modules: most frozen modules in any iteration.
        visits: (S,) frames each stream was watched.
        saved: the saves, in order.
        last: the time since the last save.
        lines: for each name of `LINES` its values, (n,) or flattened.
        told: names of the signals that have a value anywhere in the run.
        states: (S,) what became of each stream, by codes as in the signal `state`.
    """

    header: RunHeader
    iterations: int
    frames: int
    blocks: Blocks
    end: int
    tau: int
    outputs: int
    modules: int
    visits: NDArray[np.int64]
    saved: tuple[Saved, ...]
    last: Phase | None
    lines: dict[str, FloatArray]
    told: frozenset[str]
    states: tuple[int, ...]

    def streams(self, most: int) -> list[int]:
        """The most watched streams, at most so many, in their own order."""
        ranked = np.argsort(-self.visits, kind="stable")[:most]
        return sorted(int(s) for s in ranked)

    def names(self) -> tuple[str, ...]:
        """Names of the streams."""
        return self.header.spec.streams


class Tally:
    """Sums a run up, as its records come."""

    def __init__(self, header: RunHeader) -> None:
        self.header = header
        self._visits = np.zeros(len(header.spec.streams), dtype=np.int64)
        self._blocks: list[Blocks] = []
        self._lines: dict[str, list[FloatArray]] = {name: [] for name in LINES}
        self._saved: list[Saved] = []
        self._iterations = self._modules = self._tau = self._outputs = 0
        self._last: Phase | None = None
        self._told: set[str] = set()
        self._states: tuple[int, ...] = (NO_STATE,) * len(self._visits)

    def add(self, columns: SignalColumns) -> None:
        """Take the next records in."""
        _, self._tau, self._outputs = columns["y"].shape
        self._blocks.append(Blocks.of(columns))
        self._visits += self._tau * np.bincount(columns["stream"], minlength=len(self._visits))
        for name, parts in self._lines.items():
            parts.append(columns[name].reshape(-1))
        self._modules = max(self._modules, columns["y_frozen"].shape[1])
        self._saved += [_save_of(columns, i) for i in np.flatnonzero(columns["saved"]).tolist()]
        self._iterations += len(columns)
        self._last = self._phase(columns)
        self._told |= {name for name in SIGNALS.keys() - self._told if told(name, columns[name])}
        self._states = tuple(columns["state"][-1].tolist())

    def _phase(self, columns: SignalColumns) -> Phase:
        """The last abstraction's phase, as far as it has come."""
        module, before = int(columns["module"][-1]), self._last
        own = columns["module"] == module
        if before is None or before.module != module:
            before = Phase(module, 0, 0, np.zeros_like(self._visits))
        return Phase(
            module,
            before.blocks + int(own.sum()),
            before.novel + int(columns["novel"][own].sum()),
            before.visits + np.bincount(columns["stream"][own], minlength=len(self._visits)),
        )

    def outline(self) -> Outline:
        """What was taken in, in short."""
        blocks = Blocks.joined(self._blocks)
        return Outline(
            header=self.header,
            iterations=self._iterations,
            frames=int(self._visits.sum()),
            blocks=blocks,
            end=int(blocks.starts[-1]) + self._tau if self._iterations else 0,
            tau=self._tau,
            outputs=self._outputs,
            modules=self._modules,
            visits=self._visits.copy(),
            saved=tuple(self._saved),
            last=self._last,
            lines={
                name: np.concatenate([np.empty(0), *parts]) for name, parts in self._lines.items()
            },
            told=frozenset(self._told),
            states=self._states,
        )


def read_outline(path: Path) -> Outline:
    """Read a run through once; see `read_stretches`."""
    tally = Tally(read_header(path))
    for columns in read_columns(path, tally.header):
        tally.add(columns)
    return tally.outline()


def _save_of(columns: SignalColumns, place: int) -> Saved:
    found = ((field.name, columns[field.name][place].tolist()) for field in fields(Saved))
    values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in found}
    return Saved(**values)
