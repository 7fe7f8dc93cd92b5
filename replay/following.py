"""The quantity of the world that each module's output follows, for reports and views."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from cdmisfa.core.arrays import FloatArray, IntArray
from replay.runs.columns import SignalColumns
from replay.runs.folders import MODULES_FILE, run_log
from replay.runs.log import (
    WATCHED_TOPIC,
    Frames,
    RunHeader,
    read_batches,
    read_columns,
)
from replay.runs.modules import load_modules
from replay.runs.run import Outline

# Last frames of each module's output that are fitted.
KEPT = 20_000

# By how much a function must be followed better than a simpler one.
BETTER = 0.03

# Sines of an angle that are tried.
FREQUENCIES = 12

# Blocks before the save whose output is shown with that of the frozen module later.
LAST_BLOCKS = 40


@dataclass(frozen=True, slots=True)
class OutputHistory:
    """A frozen module's output wherever its own stream was watched.

    Attributes:
        t: (n,) frames at which that stream was watched after the save.
        y: (n,) its first output there.
        truth: (n, D) ground truth at these frames; D may be 0.
        angles: columns of truth that go round in the run; None: those that do at these frames.
    """

    module: int
    stream: int
    t: IntArray
    y: FloatArray
    truth: FloatArray
    angles: tuple[int, ...] | None = None

    def best_fit(self, names: Sequence[str]) -> Fit | None:
        """The quantity that the output follows most, and how; None where there is no truth.

        Of a long output the last `KEPT` frames count.

        Args:
            names: of the columns of truth.
        """
        return next(iter(self.fits(names)), None)

    def fits(self, names: Sequence[str]) -> list[Fit]:
        """How the output follows each quantity, the one that it follows most first."""
        truth, y = self.truth[-KEPT:], self.y[-KEPT:]
        angles = _angles(truth) if self.angles is None else self.angles
        found = [
            fit
            for column, name in enumerate(names[: truth.shape[1]])
            if (fit := simplest_fit(truth[:, column], y, column, name, angle=column in angles))
        ]
        return sorted(found, key=lambda fit: -fit.r)


@dataclass(frozen=True, slots=True)
class Fit:
    """A function of a true quantity that an output follows.

    Attributes:
        column: of the truth.
        function: in words, of the truth's name.
        r: correlation of the output with the function, 0 to 1.
        weights: (K,) of the terms.
        terms: (n,) truth -> (n, K).
    """

    column: int
    function: str
    r: float
    weights: FloatArray
    terms: Callable[[FloatArray], FloatArray]

    def __call__(self, truth: FloatArray) -> FloatArray:
        """The function's values."""
        return np.asarray(self.terms(truth) @ self.weights)


def simplest_fit(
    truth: FloatArray, y: FloatArray, column: int, name: str, *, angle: bool
) -> Fit | None:
    """The simplest function of a true quantity that an output follows.

    Of an angle these are its sines, of all others a straight line or, where
    that is better by `BETTER`, a parabola: a slow feature need not be the quantity itself.

    Args:
        truth: (n,) its values.
        y: (n,) the output.
        column: number of the quantity.
        name: its name.
        angle: it is one that goes round.
    """
    if len(truth) < 3 or np.std(truth) == 0 or np.std(y) == 0:
        return None
    powers = range(1, min(len(np.unique(truth)), 3))
    tried = [
        (name if k == 1 else f"a parabola of {name}", partial(_powers, degree=k)) for k in powers
    ]
    if angle:
        tried += [
            (f"sin({name if k == 1 else f'{k} {name}'} + c)", partial(_sines, frequency=k))
            for k in range(1, FREQUENCIES + 1)
        ]
    best: Fit | None = None
    for function, terms in tried:
        table = terms(truth)
        weights: FloatArray = np.linalg.lstsq(table, y, rcond=None)[0].astype(np.float64)
        fit = table @ weights
        r = float(np.corrcoef(fit, y)[0, 1]) if np.std(fit) > 0 else 0.0
        if best is None or r > best.r + BETTER:
            best = Fit(column, function, r, weights, terms)
    return best


def _powers(x: FloatArray, degree: int) -> FloatArray:
    return np.stack([x**k for k in range(degree + 1)], axis=1)


def _sines(x: FloatArray, frequency: int) -> FloatArray:
    return np.stack([np.ones_like(x), np.sin(frequency * x), np.cos(frequency * x)], axis=1)


def _angles(truth: FloatArray) -> tuple[int, ...]:
    """Columns of (n, D) truth that are angles of all around a circle, in radians."""
    if not len(truth):
        return ()
    turn = 2 * np.pi
    low, high = truth.min(axis=0), truth.max(axis=0)
    return tuple(np.flatnonzero((low >= 0) & (high <= turn) & (high - low > 0.9 * turn)).tolist())


def read_outputs(
    path: Path, outline: Outline, truth: Frames, modules: int, most: int
) -> tuple[OutputHistory, ...]:
    """The outputs of the first modules of a run on their own streams; see `read_batches`.

    If a module's stream was not watched after its save, it is the module's output on its last
    frames before, where the module was kept; otherwise the output of the abstraction while it was
    still changing.

    Args:
        path: of the run.
        outline: the run in short.
        truth: frames and the ground truth of each.
        modules: how many, at most.
        most: last frames of each.
    """
    header = outline.header
    collectors = [
        _OutputCollector(save.module, save.stream, alone=header.by_progress)
        for save in outline.saved[:modules]
    ]
    if not collectors:
        return ()
    for columns in read_columns(path, header):
        for collector in collectors:
            collector.add(columns)
    outputs = {c.number: c.last(most) for c in collectors if c.blocks}
    silent = {c.number: outputs[c.number][0] for c in collectors if c.blocks and c.is_silent}
    outputs |= _of_kept_modules(path, header, silent)
    angles = _angles(truth[1])
    return tuple(
        OutputHistory(c.number, c.stream, t, y, _truth_at(t, truth), angles)
        for c in collectors
        if c.number in outputs
        for t, y in [outputs[c.number]]
        if len(t)
    )


def _of_kept_modules(
    path: Path, header: RunHeader, silent: Mapping[int, IntArray]
) -> dict[int, Frames]:
    """Outputs of modules that were kept on frames that the log holds."""
    log = run_log(path)
    if not silent or not (log.parent / MODULES_FILE).is_file():
        return {}
    kept = {m.index: m for m in load_modules(log.parent) if m.index in silent}
    found: dict[int, list[Frames]] = {number: [] for number in kept}
    for batch in read_batches(path, header, topics=(WATCHED_TOPIC,)):
        for frames, shown in batch.watched:
            for number, module in kept.items():
                own = np.isin(frames, silent[number])
                if own.any():
                    found[number].append((frames[own], module.transform(shown[own])[:, 0]))
    return {number: _in_one(parts) for number, parts in found.items() if parts}


def _in_one(parts: Sequence[Frames]) -> Frames:
    frames, values = zip(*parts, strict=True)
    return np.concatenate(frames), np.concatenate(values)


def _truth_at(t: IntArray, truth: Frames) -> FloatArray:
    """(n, D) ground truth at n frames; D is 0 where not all of them have it."""
    frames, values = truth
    if len(t):
        at = np.searchsorted(frames, t)
        if at.max() < len(frames) and (frames[at] == t).all():
            return values[at]
    return np.empty((len(t), 0))


class _OutputCollector:
    """A module's outputs whenever its own stream is watched; before its save the last ones.

    Args:
        module: its number.
        stream: its own.
        alone: it was learned from its own stream alone, while others were learned from theirs.
    """

    def __init__(self, module: int, stream: int, *, alone: bool) -> None:
        self.number, self.stream, self._alone = module, stream, alone
        self.is_silent = True
        self.blocks: list[tuple[int, FloatArray]] = []

    def add(self, columns: SignalColumns) -> None:
        own, frozen = columns["stream"] == self.stream, columns["y_frozen"]
        if frozen.shape[1] >= self.number:
            outputs = frozen[own, self.number - 1, :, 0]
            self.is_silent &= not own.any()
            self.blocks += zip(columns.frames[own].tolist(), outputs, strict=True)
            return
        # Before it is frozen the abstraction still changes: only its last blocks count.
        own &= self._alone | (columns["module"] == self.number)
        own &= np.isfinite(columns["y"]).all(axis=(1, 2))
        self.blocks += zip(columns.frames[own].tolist(), columns["y"][own, :, 0], strict=True)
        del self.blocks[: -LAST_BLOCKS - int(columns["saved"][own].any())]

    def last(self, most: int) -> Frames:
        """The last `most` frames, and the output at each."""
        blocks = self.blocks[-max(most // max(len(self.blocks[0][1]), 1), 1) :]
        return _in_one([(start + np.arange(len(y)), y) for start, y in blocks])
