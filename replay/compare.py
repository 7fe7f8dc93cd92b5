"""Whether two runs are the same, bit for bit, and where they part if they are not."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.signals import BlockSignals, canonical_bytes, values
from replay.runlog import read_signals


@dataclass(frozen=True, slots=True)
class Difference:
    """The first place where two runs differ.

    Attributes:
        iteration: of the record, from 0.
        signal: name of its first signal that differs, or "" where one run has ended.
        place: index of the first element that differs; () for a scalar or a shape.
        first: the value in the first run, as text.
        second: the value in the second run, as text.
    """

    iteration: int
    signal: str
    place: tuple[int, ...]
    first: str
    second: str

    def __str__(self) -> str:
        if not self.signal:
            return f"iteration {self.iteration}: {self.first} against {self.second}"
        place = f"[{', '.join(map(str, self.place))}]" if self.place else ""
        where = f"iteration {self.iteration}: {self.signal}{place}"
        return f"{where} is {self.first} against {self.second}"

    def as_json(self) -> dict[str, Any]:
        """The difference as JSON values."""
        return {
            "iteration": self.iteration,
            "signal": self.signal,
            "place": list(self.place),
            "first": self.first,
            "second": self.second,
        }


def compare(first: Path, second: Path) -> Difference | None:
    """The first difference between two runs' signals, or None where every bit is the same.

    Raises:
        UsageError: one of them is no run.
        LogDamagedError: one of them cannot be read.
    """
    pairs = zip_longest(read_signals(first), read_signals(second))
    for iteration, (a, b) in enumerate(pairs):
        if a is None or b is None:
            ended, more = f"ended after {iteration} iterations", "goes on"
            return Difference(
                iteration, "", (), ended if a is None else more, ended if b is None else more
            )
        if canonical_bytes(a) != canonical_bytes(b):
            return _difference(iteration, a, b)
    return None


def _difference(iteration: int, a: BlockSignals, b: BlockSignals) -> Difference:
    for (signal, x), (_, y) in zip(values(a), values(b), strict=True):
        if x.shape != y.shape:
            return Difference(
                iteration, signal.name, (), f"of shape {x.shape}", f"of shape {y.shape}"
            )
        differs = np.flatnonzero(_differ(x, y))
        if len(differs):
            place = tuple(int(i) for i in np.unravel_index(differs[0], x.shape))
            return Difference(iteration, signal.name, place, _text(x[place]), _text(y[place]))
    raise AssertionError("records with different bytes have the same values")


def _differ(x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.bool_]:
    """Where two arrays differ in a bit, (size,); one NaN is as good as another."""
    both_nan = np.ravel(np.isnan(x) & np.isnan(y))
    width = np.dtype(f"u{x.dtype.itemsize}")
    bits = [np.ascontiguousarray(value).view(width).reshape(-1) for value in (x, y)]
    differ: NDArray[np.bool_] = (bits[0] != bits[1]) & ~both_nan
    return differ


def _text(value: Any) -> str:
    """A number with every digit that tells it from its neighbours."""
    return repr(value.item())
