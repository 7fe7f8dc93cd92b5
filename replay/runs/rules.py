"""The rules by which CD-MISFA saves a module: signals, thresholds, and how far each is met."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from cdmisfa.core.arrays import FloatArray
from replay.runs.columns import SignalColumns
from replay.runs.log import RunHeader


@dataclass(frozen=True, slots=True)
class Rule:
    """A signal that must be above a threshold, or below it, for a module to be saved.

    Attributes:
        signal: its name.
        symbol: what it is called.
        threshold: where it must be.
        side: on which side of it.
    """

    signal: str
    symbol: str
    threshold: float
    side: Literal["above", "below"]

    @property
    def ratio(self) -> str:
        """What must be above 1, in words."""
        if self.side == "below":
            return f"{self.threshold:g} / {self.symbol}"
        return f"{self.symbol} / {self.threshold:g}"

    def met(self, columns: SignalColumns) -> FloatArray:
        """(n,) values of that ratio; of several outputs the worst counts."""
        values = np.abs(columns[self.signal].astype(np.float64).reshape(len(columns), -1))
        ratios = values / self.threshold
        with np.errstate(divide="ignore"):
            met = 1 / ratios if self.side == "below" else ratios
        return np.asarray(met.min(axis=1))


def rules_of(header: RunHeader) -> list[Rule]:
    """The rules of a run's learner, as far as its log states them; none of other learners."""
    if header.by_progress:
        return []
    falls = ("roc_error", "clustering error") if header.clusters else ("eta_dot", "|η̇|")
    key = "roc_error" if header.clusters else "delta"
    rules = [
        (*falls, header.number(key), "below"),
        ("share", "share", header.number("novel_share"), "above"),
        ("variance", "variance", header.number("min_variance"), "above"),
    ]
    return [Rule(*rule) for rule in rules if rule[2]]  # type: ignore[arg-type]
