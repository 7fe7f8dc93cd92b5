"""Abrupt changes: the epsilon until which the agent still learns the new optimum."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cdmisfa.core.arrays import FloatArray
from cdmisfa.experiments.results import logistic_midpoint, mean_interval
from cdmisfa.experiments.trial import Swap, run_oscillatory_trial
from cdmisfa.studies.paper import figures
from cdmisfa.studies.paper.experiment import (
    Experiment,
    Findings,
    Output,
    Settings,
    Trial,
    groups,
    paper_config,
)

# The paper's values of epsilon^c.
CHANGES = (1.0, 0.96, 0.93, 0.9, 0.86, 0.83, 0.8, 0.76, 0.73, 0.7, 0.6, 0.5, 0.3, 0.1)

QUICK_CHANGES = (1.0, 0.86, 0.8, 0.7, 0.3)

# Table 1: the paper's epsilon^d.
SIGMAS = {0.008: 0.8933, 0.003: 0.8775, 0.0009: 0.7211, 0.0001: 0.6517, 0.0: 0.6483}

NUS = {0.02: 0.78, 0.03: 0.80, 0.04: 0.79, 0.05: 0.81}

# Table 2: the paper's epsilon^d.
TAUS: Mapping[float, float] = {10: 0.98, 30: 0.81, 50: 0.83, 100: 0.80}

COLUMNS: Mapping[str, Mapping[float, float]] = {"sigma": SIGMAS, "nu": NUS, "tau": TAUS}
QUICK_COLUMNS = {"sigma": {sigma: SIGMAS[sigma] for sigma in (0.008, 0.0009, 0.0)}}

# Factor of epsilon in every iteration; the paper does not give it, see decision 0013
# in docs/project/decisions.md.
DECAY = 0.998

# Smallest mean number of rewarded blocks before a change. With fewer, the agent had hardly found an
# optimum that it could leave.
MIN_REWARDED = 30

CONTRADICTION = (
    "The paper's tables contradict each other: sigma = 0.0009, nu = 0.05 and tau = 100 are one "
    f"setting, with epsilon^d {SIGMAS[0.0009]} in the table of sigma, {NUS[0.05]:.2f} in that of "
    f"nu and {TAUS[100]:.2f} in that of tau. Nothing that depends on the setting alone can give "
    "all three."
)

OLD, NEW = "101", "011"

# Values of sigma in the paper's figure.
FIGURE_SIGMAS = (0.0001, 0.008)

# Marker, marker size and dashes of each stream, which stay distinct where curves overlap.
STYLES = (("o", 7, "-"), ("s", 5, (0, (4, 2))), ("^", 3, (0, (1, 1.5))))


@dataclass(frozen=True, slots=True)
class Point:
    """Epsilon^d at one value of a key.

    Attributes:
        value: the midpoint of "converged to the new optimum"; NaN if no trial or every trial did.
        pseudo: (seeds,) pseudo-values of the jackknife over seeds, whose mean is `value` and
            whose spread tells how certain it is: trials of a seed are not independent.
        followed, neither: number of trials that ended in the new optimum, and in neither optimum.
        n: number of trials.
        limit: the largest epsilon^c with enough rewarded blocks.
    """

    value: float
    pseudo: FloatArray
    followed: int
    neither: int
    n: int
    limit: float

    @property
    def rank(self) -> float:
        """Epsilon^d for comparison; 2 if it is above every epsilon^c, 0 if below."""
        if math.isnan(self.value):
            return 0.0 if self.followed else 2.0
        return self.value

    def __str__(self) -> str:
        return f"{self.value:.3f}" if self.rank <= self.limit else f"above {self.limit:g}"


class NonStationary(Experiment):
    """Late changes keep the old optimum; epsilon^d is lower for a smaller sigma."""

    title = "Non-stationary environments"
    trials = (20, 3)

    def conditions(self, quick: bool, recording: Path | None) -> list[Settings]:
        """Tables 1 and 2: every epsilon^c for every value of a key."""
        return [
            {"key": key, "value": value, "epsilon_c": epsilon}
            for key, values in (QUICK_COLUMNS if quick else COLUMNS).items()
            for value in values
            for epsilon in (QUICK_CHANGES if quick else CHANGES)
        ]

    def run(self, settings: Settings) -> Output:
        """Show zero, x2, x3; the first becomes x1 when epsilon falls below epsilon^c."""
        keys = {settings["key"]: settings["value"]}
        decays = dict.fromkeys(("epsilon_decay", "epsilon_tail_decay"), DECAY)
        result = run_oscillatory_trial(
            paper_config("oscillatory", **keys, **decays, patience=1),
            ("zero", "x2", "x3"),
            seed=settings["seed"],
            max_modules=1,
            swap=Swap(settings["epsilon_c"], 0, "x1"),
            curves=True,
        )
        curves: Any = result.curves
        before = curves["reward"][: result.swapped if result.swapped >= 0 else None]
        policy = result.modules[0].policy if result.modules else result.final_policy
        rewarded = int(np.isfinite(before).sum())
        return {"policy": "".join(map(str, policy)), "rewarded": rewarded}, {}

    def evaluate(self, trials: Sequence[Trial], findings: Findings) -> None:
        """Compare epsilon^d with both tables and with the statements of the text."""
        judged = _judged(trials)
        limit = max(t.settings["epsilon_c"] for t in judged)
        points = {at: _point(of, limit) for at, of in groups(judged, "key", "value").items()}
        rows = []
        for (key, value), point in points.items():
            low, high = mean_interval(point.pseudo)
            between = f"{low:.3f} .. {high:.3f}" if point.value <= limit else "-"
            paper, ends = f"{COLUMNS[key][value]:g}", f"{point.n - point.neither} of {point.n}"
            rows.append([f"{key} = {value:g}", paper, str(point), between, ends])
        head = ("at", "paper's epsilon^d", "ours", "95 % interval, by seeds", "old or new optimum")
        findings.table(head, rows)
        _claim_about_changes(findings, judged, points)
        _claim_about_order(findings, points)
        rewarded = ", ".join(
            f"{epsilon:g}: {_rewarded(group):.0f}"
            for (epsilon,), group in groups(trials, "epsilon_c").items()
            if epsilon >= 0.7
        )
        note = (
            f"Blocks rewarded before the change, by epsilon^c: {rewarded}. Above {limit:g} they "
            f"are fewer than {MIN_REWARDED}, and the agent has hardly an optimum to leave: changes "
            "there are left out, and where epsilon^d lies there it is only said to be above "
            f"{limit:g}."
        )
        findings.notes = [note, CONTRADICTION]

    def draw(self, trials: Sequence[Trial], folder: Path) -> list[Path]:
        """Draw policies against epsilon^c for two values of sigma; gray where rewards are few."""
        of_sigma = {v: of for (k, v), of in groups(trials, "key", "value").items() if k == "sigma"}
        both = of_sigma.keys() >= {*FIGURE_SIGMAS}
        sigmas = FIGURE_SIGMAS if both else (min(of_sigma), max(of_sigma))
        figure, axes = figures.new_figure(1, 2)
        for panel, sigma, letter in zip(axes[0], sigmas, "ab", strict=True):
            _draw_policies(panel, of_sigma[sigma])
            axis = rf"$\epsilon$ at the change ($\sigma$ = {sigma:g})"
            figures.letter_panel(panel, letter, axis, "mean final policy")
            panel.set_ylim(-0.07, 1.07)
            panel.set_yticks([0, 1], ["stay", "switch"])
        return [figures.save_figure(figure, folder, "nonstationary")]


def point_of_no_return(trials: Sequence[Trial]) -> float:
    """Return epsilon^d: the midpoint of "converged to the new optimum" against epsilon^c."""
    changes = [t.settings["epsilon_c"] for t in trials]
    return logistic_midpoint(changes, [_is_new(t) for t in trials])


def _point(trials: Sequence[Trial], limit: float) -> Point:
    value, seeds = point_of_no_return(trials), sorted({t.settings["seed"] for t in trials})
    without = [point_of_no_return([t for t in trials if t.settings["seed"] != s]) for s in seeds]
    pseudo = value + (len(seeds) - 1) * (np.mean(without) - np.array(without))
    neither = sum(t.row["policy"] not in (OLD, NEW) for t in trials)
    return Point(value, pseudo, sum(map(_is_new, trials)), neither, len(trials), limit)


def _is_new(trial: Trial) -> bool:
    return bool(trial.row["policy"] == NEW)


def _claim_about_changes(
    findings: Findings, judged: Sequence[Trial], points: Mapping[tuple[str, float], Point]
) -> None:
    """Add claims: early changes are followed, late ones are not, and every policy is an optimum."""
    smallest = min(value for key, value in points if key == "sigma")
    changes = {t.settings["epsilon_c"] for t in judged}
    largest, last = max(changes), min(changes)
    early = groups(judged, "key", "value", "epsilon_c")["sigma", smallest, largest]
    late = groups(judged, "key", "epsilon_c")["sigma", last]
    followed, stayed = sum(map(_is_new, early)), sum(not _is_new(t) for t in late)
    findings.claim(
        "a change above epsilon^d is followed (smallest sigma, largest epsilon^c)",
        followed >= 0.8 * len(early),
        f"{followed} of {len(early)} trials with epsilon^c = {largest:g}",
    )
    detail = f"{stayed} of {len(late)} trials with epsilon^c = {last:g}"
    findings.claim("a change while epsilon is small is not followed", stayed == len(late), detail)
    lost, n = (sum(getattr(t, name) for t in points.values()) for name in ("neither", "n"))
    (key, value), worst = max(points.items(), key=lambda item: item[1].neither / item[1].n)
    most = f", most at {key} = {value:g} ({worst.neither} of {worst.n})" if lost else ""
    ends = "the policy ends in the old or in the new optimum"
    findings.claim(ends, lost == 0, f"{lost} of {n} trials in neither{most}")


def _claim_about_order(findings: Findings, points: Mapping[tuple[str, float], Point]) -> None:
    """Add claims about the effect of sigma on epsilon^d and, if they vary, of nu and tau."""
    columns: dict[str, dict[float, Point]] = {}
    for (key, value), point in sorted(points.items()):
        columns.setdefault(key, {})[value] = point
    of_sigma = list(columns["sigma"].values())[::-1]
    order = [min(point.rank, point.limit) for point in of_sigma]
    falls = order == sorted(order, reverse=True) and order[0] > order[-1]
    words = ", ".join(map(str, of_sigma))
    findings.claim("epsilon^d falls with sigma, and nowhere rises", falls, words)
    for key, reference, claim in (
        ("nu", 0.05, "nu has no significant effect on epsilon^d"),
        ("tau", 100, "tau of 30 and more has none"),
    ):
        of_key = {v: point for v, point in columns.get(key, {}).items() if (key, v) != ("tau", 10)}
        if len(of_key) < 2:
            continue
        against = of_key[reference]
        rest = {v: point.pseudo for v, point in of_key.items() if v != reference}
        differ = {v: mean_interval(seeds - against.pseudo) for v, seeds in rest.items()}
        words = ", ".join(f"{v:g}: {low:+.3f} .. {high:+.3f}" for v, (low, high) in differ.items())
        same: bool | None = all(low <= 0 <= high for low, high in differ.values())
        if same and any(point.rank > point.limit for point in of_key.values()):
            same = None  # where one of them lies cannot be judged
        findings.claim(claim, same, f"against {reference:g}, 95 % intervals: {words}")
    if "tau" in columns:
        shortest, *longer = columns["tau"].values()
        words = ", ".join(map(str, columns["tau"].values()))
        higher = shortest.rank > max(point.rank for point in longer)
        findings.claim("epsilon^d is higher at tau = 10", higher, words)


def _judged(trials: Sequence[Trial]) -> list[Trial]:
    """Return the trials of each epsilon^c with enough rewarded blocks before the change."""
    by_change = groups(trials, "epsilon_c").values()
    return [trial for group in by_change if _rewarded(group) >= MIN_REWARDED for trial in group]


def _rewarded(trials: Sequence[Trial]) -> float:
    return float(np.mean([t.row["rewarded"] for t in trials]))


def _draw_policies(panel: Any, trials: Sequence[Trial]) -> None:
    by_change = sorted(groups(trials, "epsilon_c").items())
    epsilons = [epsilon for (epsilon,), _ in by_change]
    mean = [np.mean([[*map(int, t.row["policy"])] for t in of], axis=0) for _, of in by_change]
    for s, (marker, size, dashes) in enumerate(STYLES):
        style = {"linewidth": 1, "linestyle": dashes, "color": figures.COLOURS[s]}
        values = [policy[s] for policy in mean]
        name = figures.STREAM_NAMES[s]
        panel.plot(epsilons, values, marker=marker, markersize=size, label=name, **style)
    judged = _judged(trials)
    point = point_of_no_return(judged)
    if math.isfinite(point):
        panel.axvline(point, color="grey", linestyle="-.", linewidth=1, label=r"$\epsilon^d$")
    least = max(t.settings["epsilon_c"] for t in judged)
    panel.axvspan(least, max(epsilons), color="grey", alpha=0.15, linewidth=0)
    figures.place_legend_above(panel)
