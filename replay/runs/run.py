"""A run on disk, its outline, and the rules by which its learner saved modules."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray, IntArray
from cdmisfa.core.errors import LogDamagedError
from cdmisfa.core.signals import NO_STATE, SIGNALS
from cdmisfa.modules import Module
from replay.runs.columns import Blocks, SignalColumns
from replay.runs.folders import read_run_json, run_log
from replay.runs.log import RunHeader, read_columns, read_header
from replay.runs.modules import load_modules

# Signals whose values an outline holds for every iteration.
LINES = (
    *("eta", "eta_dot", "reward", "curiosity", "expert", "xi", "share", "epsilon"),
    *("change", "tested", "fitted", "learning_error", "interest", "typical", "regret"),
    *("module", "novel", "novel_blocks", "roc_error", "variance"),
)


class StoredRun:
    """A run on disk; each part is read when it is asked for.

    Args:
        path: the run's folder, or its log.

    Raises:
        UsageError: there is no such run, or it has another version of the signals.
        LogDamagedError: its log cannot be read, here or in any later access.
    """

    def __init__(self, path: str | Path) -> None:
        self.log = run_log(Path(path))
        self.header: RunHeader = read_header(self.log)

    @property
    def streams(self) -> tuple[str, ...]:
        """Names of the streams."""
        return self.header.spec.streams

    @cached_property
    def result(self) -> Mapping[str, Any] | None:
        """The document that `learn --json` prints; None if the run did not finish."""
        return read_run_json(self.log.parent).get("result")

    @cached_property
    def modules(self) -> tuple[Module, ...]:
        """Modules in the order of learning.

        Raises:
            LogDamagedError: the modules are of other streams, or cannot be read.
        """
        modules, names = load_modules(self.log.parent), self.streams
        if any(module.stream_index >= len(names) for module in modules):
            raise LogDamagedError(
                f"{self.log.parent} has modules of streams that the run does not have"
            )
        kind = self.header.spec.kind
        return tuple(
            replace(m, stream=names[m.stream_index], frame_shape=kind(m.stream_index)[0])
            for m in modules
        )


@dataclass(frozen=True, slots=True)
class Save:
    """Signals of the iteration at whose end a module was saved."""

    module: int
    stream: int
    iteration: int
    t: int
    policy: tuple[int, ...]
    eta: tuple[float, ...]
    eta_dot: tuple[float, ...]

    @classmethod
    def of(cls, columns: SignalColumns, row: int) -> Save:
        """Return the save that a row of the records is about."""
        values = {f.name: columns[f.name][row].tolist() for f in fields(cls)}
        values |= {k: tuple(v) for k, v in values.items() if isinstance(v, list)}
        return cls(**values)


@dataclass(frozen=True, slots=True)
class Phase:
    """Blocks in which one abstraction was learned.

    Attributes:
        module: number of the abstraction.
        blocks: number of its blocks.
        novel: number of blocks that the gate let through.
        novel_of: (S,) number of these blocks for each stream.
    """

    module: int
    blocks: int
    novel: int
    novel_of: IntArray


@dataclass(frozen=True, slots=True)
class Outline:
    """Outline of a run.

    Attributes:
        iterations: number of records.
        frames: number of attended frames.
        blocks: blocks of all records.
        end: frame after the last record; the source may have had more frames than were attended.
        tau: frames of a block.
        outputs: outputs of an abstraction.
        modules: largest number of frozen modules in any iteration.
        visits: (S,) attended frames of each stream.
        saved: saves in order.
        last: phase since the last save.
        lines: values of each signal in `LINES`, (n,) or flattened.
        states: (S,) final state of each stream, as codes of the signal `state`.
        changes: (n, 3) block, stream and new code of every change of a state, ordered by block.
    """

    header: RunHeader
    iterations: int
    frames: int
    blocks: Blocks
    end: int
    tau: int
    outputs: int
    modules: int
    visits: IntArray
    saved: tuple[Save, ...]
    last: Phase | None
    lines: dict[str, FloatArray]
    states: tuple[int, ...]
    changes: IntArray = field(default_factory=lambda: np.empty((0, 3), np.int64))

    def streams(self, most: int) -> list[int]:
        """Return the indices of the most attended streams, at most `most`, in ascending order."""
        ranked = np.argsort(-self.visits, kind="stable")[:most]
        return sorted(int(s) for s in ranked)

    def names(self) -> tuple[str, ...]:
        """Return the names of the streams."""
        return self.header.spec.streams


class Tally:
    """Builds the outline of a run from its records, in batches."""

    def __init__(self, header: RunHeader) -> None:
        self.header = header
        self._values: dict[str, list[NDArray[Any]]] = {
            name: [] for name in ("t", "iteration", "stream", *LINES)
        }
        self._saved: list[Save] = []
        self._modules = self._tau = self._outputs = 0
        self._states: tuple[int, ...] = (NO_STATE,) * len(header.spec.streams)
        self._changes = [np.empty((0, 3), np.int64)]
        self._count = 0

    def add(self, columns: SignalColumns) -> None:
        """Add the next records."""
        _, self._tau, self._outputs = columns["y"].shape
        for name, parts in self._values.items():
            parts.append(columns[name].reshape(-1).copy())  # a view would hold the whole batch
        self._modules = max(self._modules, columns["y_frozen"].shape[1])
        self._saved += [Save.of(columns, row) for row in np.flatnonzero(columns["saved"]).tolist()]
        rows, streams = np.nonzero(np.diff(columns["state"], axis=0, prepend=[self._states]))
        codes = columns["state"][rows, streams]
        self._changes.append(np.column_stack([self._count + rows, streams, codes]))
        self._states = tuple(columns["state"][-1].tolist())
        self._count += len(columns)

    def outline(self) -> Outline:
        """Return the outline of all records so far."""
        values: dict[str, Any] = {
            name: np.concatenate([np.empty(0, SIGNALS[name].dtype), *parts])
            for name, parts in self._values.items()
        }
        blocks = Blocks(values["t"], values["iteration"], values["stream"])
        streams, n = len(self._states), len(blocks.starts)
        last = None
        if n:
            module = values["module"]
            in_phase = module == module[-1]
            novel = in_phase & values["novel"].astype(bool)
            novel_of = np.bincount(blocks.streams[novel], minlength=streams)
            last = Phase(int(module[-1]), int(in_phase.sum()), int(novel.sum()), novel_of)
        return Outline(
            header=self.header,
            iterations=n,
            frames=n * self._tau,
            blocks=blocks,
            end=int(blocks.starts[-1]) + self._tau if n else 0,
            tau=self._tau,
            outputs=self._outputs,
            modules=self._modules,
            visits=self._tau * np.bincount(blocks.streams, minlength=streams),
            saved=tuple(self._saved),
            last=last,
            lines={name: values[name] for name in LINES},
            states=self._states,
            changes=np.concatenate(self._changes),
        )


def read_outline(path: Path) -> Outline:
    """Read the outline of a run; raises as `read_batches`."""
    tally = Tally(read_header(path))
    for columns in read_columns(path, tally.header):
        tally.add(columns)
    return tally.outline()


@dataclass(frozen=True, slots=True)
class SavingRule:
    """Condition for saving a module: a signal must be above or below a threshold.

    Attributes:
        signal: name of the signal.
        symbol: its symbol in formulas.
        threshold: value that it must reach.
        side: side of the threshold on which the rule holds.
    """

    signal: str
    symbol: str
    threshold: float
    side: Literal["above", "below"]

    @property
    def ratio(self) -> str:
        """Formula of the ratio that `met` computes."""
        if self.side == "below":
            return f"{self.threshold:g} / {self.symbol}"
        return f"{self.symbol} / {self.threshold:g}"

    def met(self, columns: SignalColumns) -> FloatArray:
        """Return (n,) values of the ratio, above 1 where the rule holds for every output."""
        values = np.abs(columns[self.signal].astype(np.float64).reshape(len(columns), -1))
        ratios = values / self.threshold
        with np.errstate(divide="ignore"):
            met = 1 / ratios if self.side == "below" else ratios
        return np.asarray(met.min(axis=1))


def rules_of(header: RunHeader) -> list[SavingRule]:
    """Return the rules of a CD-MISFA learner whose thresholds the header states."""
    if header.by_progress:
        return []
    error = ("roc_error", "clustering error") if header.clusters else ("eta_dot", "|η̇|")
    rules = [
        SavingRule(
            *error, header.number("roc_error" if header.clusters else "delta") or 0, "below"
        ),
        SavingRule("share", "share", header.number("novel_share") or 0, "above"),
        SavingRule("variance", "variance", header.number("min_variance") or 0, "above"),
    ]
    return [rule for rule in rules if rule.threshold]
