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

# Results of a trial as JSON values, and its arrays: curves for the figures.
Output = tuple[dict[str, Any], Mapping[str, NDArray[Any]]]


@dataclass(frozen=True, slots=True)
class Trial:
    """A finished trial.

    Attributes:
        settings: settings of the trial, including its seed.
        row: results, as JSON values.
        arrays: curves for the figures.
    """

    settings: Settings
    row: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]


class Findings:
    """The results of an experiment.

    Attributes:
        lines: rows of the table: the measured quantity, the paper's value as text ("-" if it gives
            none), mean, SD, number of trials, 95 % interval, decimals to print.
        tables: further tables, each with its head and rows of texts.
        claims: statements of the paper, and whether they are reproduced: true, false, or None if
            that cannot be decided.
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
        """Add mean, SD and 95 % interval of the mean of values to the table."""
        line = {"quantity": quantity, "paper": paper, **asdict(summary(values))}
        self.lines.append({**line, "digits": digits})

    def share(self, quantity: str, paper: str, good: int, n: int) -> None:
        """Add the share of n trials that are good."""
        self.measured(quantity, [1.0] * good + [0.0] * (n - good), paper)
        self.lines[-1]["interval"] = wilson(good, n)

    def table(self, head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Add a further table."""
        self.tables.append({"head": [*head], "rows": [[*row] for row in rows]})

    def claim(self, claim: str, holds: bool | None, detail: str) -> None:
        """Add a statement of the paper; `holds` is None if it cannot be decided."""
        self.claims.append({"claim": claim, "holds": holds, "detail": detail})

    def claim_all(self, claim: str, good: int, n: int) -> None:
        """Add a statement that holds if all of n trials are good."""
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
        title: title of its tables.
        trials: trials per condition: the paper's number, and the number of --quick.
        needs_recording: whether it needs a recording of the iCub scene.
    """

    title: str
    trials: tuple[int, int] = (20, 4)
    needs_recording = False

    def conditions(self, quick: bool, recording: Path | None) -> Sequence[Settings]:
        """Return the settings of each condition besides the seed, as JSON values."""
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
    """Return "k of n" for k good trials, bold if some are not good."""
    return f"{good} of {n}" if good == n else f"**{good} of {n}**"


def mean_text(values: ArrayLike, digits: int) -> str:
    """Return mean and SD as text; "-" without values."""
    result = summary(values)
    spread = f" ± {result.sd:.{digits}f}" if result.n > 1 else ""
    return f"{result.mean:.{digits}f}{spread}" if result.n else "-"


def first_above(first: ArrayLike, *rest: ArrayLike) -> bool | None:
    """Return whether `first` is above the rest on the same trials; None if that is uncertain."""
    bounds = [mean_interval(np.subtract(first, values)) for values in rest]
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
