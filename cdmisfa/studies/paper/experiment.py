"""The interface of the paper's experiments, and what their results consist of."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cdmisfa.experiments.results import MeanSd, mean_interval, summary, wilson
from cdmisfa.modules import Module

Settings = Mapping[str, Any]
FIRST_SEED = 28_000
"""Seed of an experiment's first trials: no reading was chosen on these, see docs/decisions."""

Output = tuple[dict[str, Any], Mapping[str, NDArray[Any]]]
"""A trial's row, in plain values, and its arrays: curves and the like, for the figures."""


@dataclass(frozen=True, slots=True)
class Request:
    """What is asked of an experiment.

    Attributes:
        trials: trials per condition; None is the paper's number, or a few where `quick` is set.
        recording: folder of a recording, for the experiments that see.
        folder: where the experiment's files go.
        force: results of more or other trials may be replaced.
    """

    trials: int | None
    quick: bool
    recording: Path | None
    folder: Path
    jobs: int = 1
    force: bool = False


@dataclass(frozen=True, slots=True)
class Trial:
    """A finished trial.

    Attributes:
        settings: what it was computed for.
        row: what it came to, in plain values.
        arrays: curves and the like, for the figures.
    """

    settings: Settings
    row: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]


class Findings:
    """What an experiment came to.

    Attributes:
        lines: of its table, as results.json has them: what was measured, the paper's value as
            text ("-" where it has none), mean, SD and number of trials, the 95 % interval where
            one was computed, and decimals to print.
        tables: others, each its head and rows of texts.
        claims: statements of the paper, and whether they came out: true, false, or None where
            that cannot be judged.
        notes: what is to be said besides.
        short: its line at the top of the page; "" where it has none.
    """

    def __init__(self) -> None:
        self.lines: list[dict[str, Any]] = []
        self.tables: list[dict[str, Any]] = []
        self.claims: list[dict[str, Any]] = []
        self.notes: list[str] = []
        self.short = ""

    def line(
        self,
        quantity: str,
        paper: str,
        found: MeanSd,
        interval: tuple[float, float] | None = None,
        *,
        digits: int = 3,
    ) -> None:
        """Add a line to the table."""
        known = {"quantity": quantity, "paper": paper, **asdict(found), "interval": interval}
        self.lines.append({**known, "digits": digits})

    def table(self, head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Add a table of its own."""
        self.tables.append({"head": [*head], "rows": [[*row] for row in rows]})

    def measured(
        self, quantity: str, values: ArrayLike, paper: str = "-", *, digits: int = 3
    ) -> None:
        """What was measured once or more."""
        self.line(quantity, paper, summary(values), digits=digits)

    def of_module(
        self,
        quantity: str,
        trials: Sequence[Trial],
        key: str,
        number: int,
        paper: str = "-",
        *,
        digits: int = 3,
    ) -> None:
        """What the rows say under a key of a module, counted from 0, where there is one."""
        values = [t.row[key][number] for t in trials if len(t.row[key]) > number]
        self.measured(quantity, values, paper, digits=digits)

    def share(self, quantity: str, paper: str, good: int, n: int) -> None:
        """How many of n trials did what is named."""
        self.line(quantity, paper, summary([1.0] * good + [0.0] * (n - good)), wilson(good, n))

    def claim(self, claim: str, holds: bool | None, detail: str) -> None:
        """Whether a statement of the paper came out; None where that cannot be judged."""
        self.claims.append({"claim": claim, "holds": holds, "detail": detail})

    def claim_all(self, claim: str, good: int, n: int) -> None:
        """That all of n trials did what is named."""
        self.claim(claim, good == n, f"{good} of {n} trials")

    def sum_up(self, topic: str, words: str) -> None:
        """The line at the top of the page, once every statement is judged."""
        whole = all(claim["holds"] for claim in self.claims)
        self.short = f"**{topic} comes out{'' if whole else ' in part'}**: {words}"


class Experiment(ABC):
    """An experiment of the paper.

    Attributes:
        title: of its section.
        trials: trials per condition, the paper's number, and enough to test the claim.
    """

    title: str
    trials: tuple[int, int] = (20, 4)

    def conditions(self, request: Request) -> Sequence[Settings]:
        """What trials differ in beside their seed, as JSON values."""
        return [{}]

    def plan(self, request: Request) -> list[Settings]:
        """Settings of every trial, seeds innermost."""
        count = request.trials or self.trials[request.quick]
        seeds = range(FIRST_SEED, FIRST_SEED + count)
        return [{**c, "seed": seed} for c in self.conditions(request) for seed in seeds]

    @abstractmethod
    def run(self, settings: Settings) -> Output:
        """One trial: its row, in plain values, and its arrays. Called in another process."""

    @abstractmethod
    def evaluate(self, trials: Sequence[Trial], found: Findings) -> None:
        """Add table and claims to what was found."""

    def draw(self, trials: Sequence[Trial], folder: Path) -> list[Path]:
        """Figures, as PNG and SVG each; some experiments have none."""
        return []


def groups(trials: Sequence[Trial], *keys: str) -> dict[tuple[Any, ...], list[Trial]]:
    """The trials whose settings have the same values of some keys, by these, in order."""
    found: dict[tuple[Any, ...], list[Trial]] = {}
    for trial in trials:
        found.setdefault(tuple(trial.settings[key] for key in keys), []).append(trial)
    return found


def of_all(good: int, n: int) -> str:
    """How many of n trials did what they should, bold where some did not."""
    return f"{good} of {n}" if good == n else f"**{good} of {n}**"


def first_above(first: ArrayLike, *others: ArrayLike) -> bool | None:
    """Whether values are above others of the same trials; None where 95 % intervals cannot say."""
    bounds = [mean_interval(np.subtract(first, other)) for other in others]
    if all(low > 0 for low, _ in bounds):
        return True
    return False if any(high < 0 for _, high in bounds) else None


def mean_of(values: ArrayLike, digits: int) -> str:
    """Mean and SD as a table has them; "-" where there is no value."""
    found = summary(values)
    spread = "" if math.isnan(found.sd) else f" ± {found.sd:.{digits}f}"
    return f"{found.mean:.{digits}f}{spread}" if found.n else "-"


def module_row(modules: Sequence[Module]) -> dict[str, list[Any]]:
    """What a row says of the modules of a trial; a policy as "011", 0 stay and 1 switch."""
    return {
        "streams": [m.stream_index for m in modules],
        "policies": ["".join(map(str, m.policy)) for m in modules],
        "saved_at": [m.iteration for m in modules],
    }


def learned_order(row: Mapping[str, Any]) -> tuple[tuple[int, str], ...]:
    """Stream and policy of each module of a trial, in the order of learning."""
    return tuple(zip(row["streams"], row["policies"], strict=True))
