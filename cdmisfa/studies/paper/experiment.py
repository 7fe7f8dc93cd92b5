"""An experiment of the paper: its settings, trials, tables and findings."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cdmisfa.core.config import LearnerConfig, build, load_preset
from cdmisfa.experiments.results import mean_interval, summary, wilson
from cdmisfa.modules import Module

Settings = Mapping[str, Any]

# A trial's row, in plain values, and its arrays: curves for the figures.
Output = tuple[dict[str, Any], Mapping[str, NDArray[Any]]]


@dataclass(frozen=True, slots=True)
class Trial:
    """A finished trial.

    Attributes:
        settings: settings of the trial, with its seed.
        row: results of the trial, as JSON values.
        arrays: curves for the figures.
    """

    settings: Settings
    row: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]


class Findings:
    """The results of an experiment.

    Attributes:
        lines: of its table: the measured quantity, the paper's value as text, "-" where it has
            none, mean, SD and number of trials, the 95 % interval of a share, decimals to print.
        tables: other tables, each with head and rows of texts.
        claims: claims of the paper, and whether each holds: True, False, or None if the trials
            cannot decide it.
        notes: limits and explanations.
    """

    def __init__(self) -> None:
        self.lines: list[dict[str, Any]] = []
        self.tables: list[dict[str, Any]] = []
        self.claims: list[dict[str, Any]] = []
        self.notes: list[str] = []

    def measured(
        self, quantity: str, values: ArrayLike, paper: str = "-", *, digits: int = 3
    ) -> None:
        """Add mean and SD of values to the table."""
        line = {"quantity": quantity, "paper": paper, **asdict(summary(values)), "interval": None}
        self.lines.append({**line, "digits": digits})

    def share(self, quantity: str, paper: str, good: int, n: int) -> None:
        """Add the share of n trials that are good."""
        self.measured(quantity, [1.0] * good + [0.0] * (n - good), paper)
        self.lines[-1]["interval"] = wilson(good, n)

    def table(self, head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Add a table of its own."""
        self.tables.append({"head": [*head], "rows": [[*row] for row in rows]})

    def claim(self, claim: str, holds: bool | None, detail: str) -> None:
        """Add a statement of the paper; `holds` is None where it cannot be judged."""
        self.claims.append({"claim": claim, "holds": holds, "detail": detail})

    def claim_all(self, claim: str, good: int, n: int) -> None:
        """Add a statement that holds where all of n trials are good."""
        self.claim(claim, good == n, f"{good} of {n} trials")

    def as_json(self) -> dict[str, Any]:
        """Return the results as JSON values."""
        return {
            "reproduced": all(claim["holds"] is not False for claim in self.claims),
            "claims": self.claims,
            "table": self.lines,
            "tables": self.tables,
            "notes": self.notes,
        }


class Experiment(ABC):
    """An experiment of the paper.

    Attributes:
        title: title of the tables.
        trials: trials per condition: the paper's number, and enough to test the claim.
        sees: True if the experiment needs a recording of the iCub scene.
    """

    title: str
    trials: tuple[int, int] = (20, 4)
    sees = False

    def conditions(self, quick: bool, recording: Path | None) -> Sequence[Settings]:
        """Return what trials differ in beside their seed, as JSON values."""
        return [{}]

    @abstractmethod
    def run(self, settings: Settings) -> Output:
        """Run one trial, in any process."""

    @abstractmethod
    def evaluate(self, trials: Sequence[Trial], findings: Findings) -> None:
        """Add tables and claims."""

    def draw(self, trials: Sequence[Trial], folder: Path) -> list[Path]:
        """Draw figures as PNG; some experiments have none."""
        return []


def paper_config(scene: str, **keys: Any) -> LearnerConfig:
    """Return the preset of a scene with some keys set."""
    return build(LearnerConfig, "learner", load_preset(scene)["learner"], keys)


def groups(trials: Sequence[Trial], *keys: str) -> dict[tuple[Any, ...], list[Trial]]:
    """Return the trials by the values of some settings, in order."""
    groups_by_key: dict[tuple[Any, ...], list[Trial]] = {}
    for trial in trials:
        groups_by_key.setdefault(tuple(trial.settings[key] for key in keys), []).append(trial)
    return groups_by_key


def of_all(good: int, n: int) -> str:
    """Return how many of n trials did what they should, bold where some did not."""
    return f"{good} of {n}" if good == n else f"**{good} of {n}**"


def mean_text(values: ArrayLike, digits: int) -> str:
    """Return mean and SD as a table has them; "-" where there is no value."""
    result = summary(values)
    spread = f" ± {result.sd:.{digits}f}" if result.n > 1 else ""
    return f"{result.mean:.{digits}f}{spread}" if result.n else "-"


def first_above(first: ArrayLike, *others: ArrayLike) -> bool | None:
    """Tell whether values are above others of the same trials; None where 95 % intervals cannot."""
    bounds = [mean_interval(np.subtract(first, other)) for other in others]
    if all(low > 0 for low, _ in bounds):
        return True
    return False if any(high < 0 for _, high in bounds) else None


def module_row(modules: Sequence[Module]) -> dict[str, list[Any]]:
    """Return the modules of a trial as part of its row; a policy is as "011", 0 stay, 1 switch."""
    return {
        "streams": [m.stream_index for m in modules],
        "policies": ["".join(map(str, m.policy)) for m in modules],
        "saved_at": [m.iteration for m in modules],
    }


def learned_order(row: Mapping[str, Any]) -> tuple[tuple[int, str], ...]:
    """Return stream and policy of each module of a trial, in the order of learning."""
    return tuple(zip(row["streams"], row["policies"], strict=True))
