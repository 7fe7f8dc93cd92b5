"""What happened in a run, in short: read once before it is shown or drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cdmisfa.signals import BlockSignals
from replay.runlog import RunHeader, read_header, read_signals

Float = NDArray[np.float64]

LINES = ("eta", "eta_dot", "reward", "curiosity", "expert", "xi", "share", "epsilon")
"""Signals whose values are kept for every iteration, to choose ranges from."""


@dataclass(frozen=True, slots=True)
class Saved:
    """The iteration at whose end a module was saved."""

    module: int
    stream: int
    iteration: int
    t: int
    policy: tuple[int, ...]
    eta: tuple[float, ...]
    eta_dot: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Outline:
    """A run in short.

    Attributes:
        header: what stands at the beginning of its log.
        iterations: number of records.
        frames: number of frames watched.
        tau: frames of a block.
        outputs: outputs of an abstraction.
        modules: most frozen modules in any iteration.
        visits: (S,) frames each stream was watched.
        saved: the saves, in order.
        policy: the last policy.
        lines: for each name of `LINES` its values, (n,) or (n J,).
    """

    header: RunHeader
    iterations: int
    frames: int
    tau: int
    outputs: int
    modules: int
    visits: NDArray[np.int64]
    saved: tuple[Saved, ...]
    policy: tuple[int, ...]
    lines: dict[str, Float]

    @property
    def delta(self) -> float | None:
        """Threshold of eta-dot, where the configuration names it."""
        value = self.header.setting("learner", "delta")
        return float(value) if isinstance(value, int | float) else None

    def streams(self, most: int) -> list[int]:
        """The most watched streams, at most so many, in their own order."""
        ranked = np.argsort(-self.visits, kind="stable")[:most]
        return sorted(int(s) for s in ranked)

    def names(self) -> tuple[str, ...]:
        """Names of the streams."""
        return self.header.spec.streams

    def span(self, *names: str, low: float | None = None) -> tuple[float, float] | None:
        """A range that shows these lines without their few wildest values.

        Args:
            names: of the lines.
            low: where the range must begin.
        """
        values = np.concatenate([self.lines[name] for name in names])
        values = values[np.isfinite(values)]
        if not len(values):
            return None
        lower, upper = (float(v) for v in np.percentile(values, (1.0, 98.0)))
        lower = lower if low is None else low
        margin = 0.1 * (upper - lower) or 0.1 * abs(upper) or 1.0
        return (lower - margin if low is None else lower), upper + margin


def read_outline(path: Path) -> Outline:
    """Read a run through once.

    Raises:
        UsageError: there is no such run.
        LogDamagedError: it cannot be read.
    """
    header = read_header(path)
    visits = np.zeros(len(header.spec.streams), dtype=np.int64)
    lines: dict[str, list[Float]] = {name: [] for name in LINES}
    saved: list[Saved] = []
    last: BlockSignals | None = None
    count = modules = 0
    for signals in read_signals(path):
        visits[signals.stream] += len(signals.y)
        for name in LINES:
            lines[name].append(np.atleast_1d(getattr(signals, name)))
        modules = max(modules, len(signals.y_frozen))
        if signals.saved:
            saved.append(_save_of(signals))
        count, last = count + 1, signals
    return Outline(
        header=header,
        iterations=count,
        frames=int(visits.sum()),
        tau=0 if last is None else len(last.y),
        outputs=0 if last is None else last.y.shape[1],
        modules=modules,
        visits=visits,
        saved=tuple(saved),
        policy=() if last is None else tuple(last.policy.tolist()),
        lines={name: _joined(parts) for name, parts in lines.items()},
    )


def _save_of(signals: BlockSignals) -> Saved:
    return Saved(
        module=signals.module,
        stream=signals.stream,
        iteration=signals.iteration,
        t=signals.t,
        policy=tuple(signals.policy.tolist()),
        eta=tuple(signals.eta.tolist()),
        eta_dot=tuple(signals.eta_dot.tolist()),
    )


def _joined(parts: Sequence[Float]) -> Float:
    return np.concatenate(parts) if parts else np.empty(0)
