"""An abrupt change: until which epsilon does the agent still learn the new optimum?"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cdmisfa.core.arrays import FloatArray
from cdmisfa.experiments.results import logistic_midpoint, mean_interval
from cdmisfa.experiments.trial import Swap, run_trial
from cdmisfa.studies import pages
from cdmisfa.studies.paper.experiment import (
    Experiment,
    Findings,
    Output,
    Request,
    Settings,
    Trial,
    groups,
)
from cdmisfa.studies.paper.oscillatory import paper_config

CHANGES = (1.0, 0.96, 0.93, 0.9, 0.86, 0.83, 0.8, 0.76, 0.73, 0.7, 0.6, 0.5, 0.3, 0.1)
"""The paper's values of epsilon^c."""

QUICK_CHANGES = (1.0, 0.86, 0.8, 0.7, 0.3)

SIGMAS = {0.008: 0.8933, 0.003: 0.8775, 0.0009: 0.7211, 0.0001: 0.6517, 0.0: 0.6483}
"""Table 1: the paper's epsilon^d."""

NUS = {0.02: 0.78, 0.03: 0.80, 0.04: 0.79, 0.05: 0.81}
TAUS: Mapping[float, float] = {10: 0.98, 30: 0.81, 50: 0.83, 100: 0.80}
"""Table 2: the paper's epsilon^d."""

COLUMNS: Mapping[str, Mapping[float, float]] = {"sigma": SIGMAS, "nu": NUS, "tau": TAUS}
QUICK_COLUMNS = {"sigma": {sigma: SIGMAS[sigma] for sigma in (0.008, 0.0009, 0.0)}}

DECAY = 0.998
"""Multiplier of epsilon throughout; the text leaves it open, decision 0013."""

REWARDED = 30
"""Rewarded blocks before a change from which on one can speak of following it.

With fewer the agent had hardly an optimum to leave.
"""

CONTRADICTION = (
    "The paper's tables contradict each other: sigma = 0.0009, nu = 0.05 and tau = 100 are one "
    f"setting, with epsilon^d {SIGMAS[0.0009]} in the table of sigma, {NUS[0.05]:.2f} in that of "
    f"nu and {TAUS[100]:.2f} in that of tau. Nothing that depends on the setting alone can give "
    "all three."
)

OLD, NEW = "101", "011"

PICTURED = (0.008, 0.0001)
"""The values of sigma that the paper shows a figure of."""

MARKERS = (("o", 7), ("s", 5), ("^", 3))
"""Marks and their sizes that stay apart where they lie on each other; one for each stream."""


@dataclass(frozen=True, slots=True)
class Turn:
    """Epsilon^d at one value of a key, from the trials that are judged.

    Attributes:
        value: the midpoint of "converged to the new optimum"; NaN where no trial did, or each.
        of_seeds: (seeds,) pseudo-values of the jackknife over seeds, whose mean is `value` and
            whose spread tells how certain it is: trials of a seed are not independent.
        followed, neither: trials that ended with the new optimum, and with none of the two.
        n: trials.
    """

    value: float
    of_seeds: FloatArray
    followed: int
    neither: int
    n: int


class NonStationary(Experiment):
    """Late changes must leave the old optimum; epsilon^d must be lower for a smaller sigma."""

    title = "Non-stationary environments"

    trials = (20, 3)

    def conditions(self, request: Request) -> list[Settings]:
        """Tables 1 and 2: every epsilon^c for every value of a key."""
        return [
            {"key": key, "value": value, "epsilon_c": epsilon}
            for key, values in (QUICK_COLUMNS if request.quick else COLUMNS).items()
            for value in values
            for epsilon in (QUICK_CHANGES if request.quick else CHANGES)
        ]

    def run(self, settings: Settings) -> Output:
        """Streams zero, x2, x3; the first becomes x1 when epsilon falls below epsilon^c."""
        keys = {settings["key"]: settings["value"]}
        decays = dict.fromkeys(("epsilon_decay", "epsilon_tail_decay"), DECAY)
        result = run_trial(
            paper_config("oscillatory", **keys, **decays, patience=1),
            ("zero", "x2", "x3"),
            seed=settings["seed"],
            max_modules=1,
            swap=Swap(settings["epsilon_c"], 0, "x1"),
            curves=True,
        )
        curves: Any = result.curves
        before = curves["reward"][: result.swapped] if result.swapped >= 0 else curves["reward"]
        policy = result.modules[0].policy if result.modules else result.final_policy
        row = {
            "policy": "".join(map(str, policy)),
            "saved": bool(result.modules),
            "iterations": result.iterations,
            "swapped": result.swapped,
            "rewarded": int(np.isfinite(before).sum()),
        }
        return row, {}

    def evaluate(self, trials: Sequence[Trial], found: Findings) -> None:
        """What of both tables comes out, and what of the text, where it can be judged."""
        judged = _judged(trials)
        limit = max(t.settings["epsilon_c"] for t in judged)
        turns = {at: _turn(of) for at, of in groups(judged, "key", "value").items()}
        rows = []
        for (key, value), turn in turns.items():
            low, high = mean_interval(turn.of_seeds)
            between = f"{low:.3f} .. {high:.3f}" if turn.value <= limit else "-"
            paper, neither = f"{COLUMNS[key][value]:g}", f"{turn.n - turn.neither} of {turn.n}"
            rows.append([f"{key} = {value:g}", paper, _in_words(turn, limit), between, neither])
        head = ("at", "paper's epsilon^d", "ours", "95 % interval, by seeds", "old or new optimum")
        found.table(head, rows)
        _claim_about_changes(found, judged, turns)
        _claim_about_order(found, turns, limit)
        seeds = len({t.settings["seed"] for t in trials})
        found.notes = [_unjudged(trials, limit), CONTRADICTION]
        of_sigma = {value: turn for (key, value), turn in turns.items() if key == "sigma"}
        smallest = min(of_sigma)
        found.sum_up(
            "The point of no return",
            f"late changes are ignored and epsilon^d falls with sigma, to "
            f"{_in_words(of_sigma[smallest], limit)} instead of {SIGMAS[smallest]:g} "
            f"({seeds} seeds), but {sum(turn.neither for turn in turns.values())} of "
            f"{len(judged)} trials end in neither optimum.",
        )

    def draw(self, trials: Sequence[Trial], folder: Path) -> list[Path]:
        """Policy against epsilon^c for two values of sigma, grey where it is not judged."""
        by_sigma = {
            value: group
            for (key, value), group in groups(trials, "key", "value").items()
            if key == "sigma"
        }
        smallest = PICTURED[1] if PICTURED[1] in by_sigma else min(by_sigma)
        figure, axes = pages.new_figure(1, 2)
        for panel, sigma, letter in zip(axes[0], (smallest, max(by_sigma)), "ab", strict=True):
            _draw_policies(panel, by_sigma[sigma])
            axis = rf"$\epsilon^c$   ($\sigma$ = {sigma:g})"
            pages.letter_panel(panel, letter, axis, "policy, mean")
            pages.stay_to_switch(panel)
        return pages.save_figure(figure, folder, "nonstationary")


def point_of_no_return(trials: Sequence[Trial]) -> float:
    """Epsilon^d: the midpoint of "converged to the new optimum" against epsilon^c."""
    changes = [t.settings["epsilon_c"] for t in trials]
    return logistic_midpoint(changes, [_is_new(t) for t in trials]).value


def _turn(trials: Sequence[Trial]) -> Turn:
    """Epsilon^d of trials at one value of a key, and what it is without each seed."""
    value, seeds = point_of_no_return(trials), {t.settings["seed"] for t in trials}
    without = [
        point_of_no_return([t for t in trials if t.settings["seed"] != seed])
        for seed in sorted(seeds)
    ]
    return Turn(
        value,
        value + (len(seeds) - 1) * (np.mean(without) - np.array(without)),
        sum(_is_new(t) for t in trials),
        sum(t.row["policy"] not in (OLD, NEW) for t in trials),
        len(trials),
    )


def _is_new(trial: Trial) -> bool:
    return bool(trial.row["policy"] == NEW)


def _claim_about_changes(
    found: Findings, judged: Sequence[Trial], turns: Mapping[tuple[str, float], Turn]
) -> None:
    """Whether changes are followed early, and not late, and where the others end."""
    smallest = min(value for key, value in turns if key == "sigma")
    changes = groups(judged, "key", "value", "epsilon_c")
    largest = max(c for key, value, c in changes if (key, value) == ("sigma", smallest))
    early = changes["sigma", smallest, largest]
    last = min(t.settings["epsilon_c"] for t in judged)
    late = groups(judged, "key", "epsilon_c")["sigma", last]
    followed, kept = sum(map(_is_new, early)), sum(not _is_new(t) for t in late)
    found.claim(
        "a change above epsilon^d is followed (smallest sigma, largest epsilon^c judged)",
        followed >= 0.8 * len(early),
        f"{followed} of {len(early)} trials with epsilon^c = {largest:g}",
    )
    detail = f"{kept} of {len(late)} trials with epsilon^c = {last:g}"
    found.claim("a change while epsilon is small is not followed", kept == len(late), detail)
    lost, n = (sum(getattr(t, name) for t in turns.values()) for name in ("neither", "n"))
    (key, value), worst = max(turns.items(), key=lambda item: item[1].neither / item[1].n)
    most = f", most at {key} = {value:g} ({worst.neither} of {worst.n})" if lost else ""
    ends = "the policy ends in the old or in the new optimum"
    found.claim(ends, lost == 0, f"{lost} of {n} trials in neither{most}")


def _claim_about_order(
    found: Findings, turns: Mapping[tuple[str, float], Turn], limit: float
) -> None:
    """How epsilon^d depends on sigma and, where they were asked, on nu and tau."""
    columns: dict[str, dict[float, Turn]] = {}
    for (key, value), turn in turns.items():
        columns.setdefault(key, {})[value] = turn
    of_sigma = [columns["sigma"][sigma] for sigma in sorted(columns["sigma"], reverse=True)]
    order = [min(_rank(turn), limit) for turn in of_sigma]
    falls = order == sorted(order, reverse=True) and order[0] > order[-1]
    words = ", ".join(_in_words(turn, limit) for turn in of_sigma)
    found.claim("epsilon^d falls with sigma, and nowhere rises", falls, words)
    for key, reference, claim in (
        ("nu", 0.05, "nu has no significant effect on epsilon^d"),
        ("tau", 100, "tau of 30 and more has none"),
    ):
        others = [v for v in columns.get(key, ()) if v != reference and (key, v) != ("tau", 10)]
        if others:
            differ = {v: _difference(columns[key][v], columns[key][reference]) for v in others}
            words = ", ".join(
                f"{v:g}: {low:+.3f} .. {high:+.3f}" for v, (low, high) in differ.items()
            )
            same: bool | None = all(low <= 0 <= high for low, high in differ.values())
            if same and any(_rank(columns[key][v]) > limit for v in (*others, reference)):
                same = None  # where one of them lies cannot be judged
            found.claim(claim, same, f"against {reference:g}, 95 % intervals: {words}")
    if "tau" in columns:
        shortest, *others = (_rank(columns["tau"][tau]) for tau in sorted(columns["tau"]))
        words = ", ".join(_in_words(columns["tau"][tau], limit) for tau in sorted(columns["tau"]))
        found.claim("epsilon^d is higher at tau = 10", shortest > max(others), words)


def _difference(one: Turn, other: Turn) -> tuple[float, float]:
    """95 % interval of the difference of two epsilon^d, seed by seed."""
    return mean_interval(one.of_seeds - other.of_seeds)


def _judged(trials: Sequence[Trial]) -> list[Trial]:
    """The trials of those epsilon^c before which blocks enough were rewarded, in the mean."""
    by_change = groups(trials, "epsilon_c").values()
    return [trial for group in by_change if _rewarded(group) >= REWARDED for trial in group]


def _rewarded(trials: Sequence[Trial]) -> float:
    return float(np.mean([t.row["rewarded"] for t in trials]))


def _unjudged(trials: Sequence[Trial], limit: float) -> str:
    """From which epsilon^c on there was little to follow a change from, in words."""
    words = ", ".join(
        f"{epsilon:g}: {_rewarded(group):.0f}"
        for (epsilon,), group in groups(trials, "epsilon_c").items()
        if epsilon >= 0.7
    )
    return (
        f"Blocks rewarded before the change, by epsilon^c: {words}. Above {limit:g} they are fewer "
        f"than {REWARDED}, and the agent has hardly an optimum to leave: changes there are left "
        f"out, and where epsilon^d lies there it is only said to be above {limit:g}."
    )


def _in_words(turn: Turn, limit: float) -> str:
    return f"{turn.value:.3f}" if _rank(turn) <= limit else f"above {limit:g}"


def _rank(turn: Turn) -> float:
    """Epsilon^d for comparison; 2 where it lies above every epsilon^c, 0 where below."""
    if math.isnan(turn.value):
        return 0.0 if turn.followed else 2.0
    return turn.value


def _draw_policies(panel: Any, trials: Sequence[Trial]) -> None:
    by_change = groups(trials, "epsilon_c")
    epsilons = [epsilon for (epsilon,) in sorted(by_change)]
    policies = [[[*map(int, t.row["policy"])] for t in by_change[e,]] for e in epsilons]
    mean = np.array([np.mean(policy, axis=0) for policy in policies])
    for s, (marker, size) in enumerate(MARKERS):
        panel.plot(
            epsilons,
            mean[:, s],
            marker=marker,
            markersize=size,
            linewidth=1,
            linestyle=pages.DASHES[s],
            color=pages.COLOURS[s],
            label=pages.STREAM_NAMES[s],
        )
    point = point_of_no_return(_judged(trials))
    if math.isfinite(point):
        panel.axvline(point, color="grey", linestyle="-.", linewidth=1, label=r"$\epsilon^d$")
    least = max(t.settings["epsilon_c"] for t in _judged(trials))
    panel.axvspan(least, max(epsilons), color="grey", alpha=0.15, linewidth=0)
    pages.explain_above(panel)
