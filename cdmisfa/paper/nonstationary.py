"""An abrupt change: until which epsilon does the agent still learn the new optimum?"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cdmisfa.experiments.statistics import Midpoint, Summary, logistic_midpoint
from cdmisfa.experiments.trial import Swap, run_trial
from cdmisfa.paper import panels
from cdmisfa.paper.oscillatory import learner_config
from cdmisfa.paper.reproduce import Claim, Findings, Line, Output, Request, Settings, Trial, groups

TITLE = "Non-stationary environments"

CHANGES = (1.0, 0.96, 0.93, 0.9, 0.86, 0.83, 0.8, 0.76, 0.73, 0.7, 0.6, 0.5, 0.3, 0.1)
"""The paper's values of epsilon^c."""

QUICK_CHANGES = (1.0, 0.86, 0.8, 0.7, 0.3)

SIGMAS = {0.008: 0.8933, 0.003: 0.8775, 0.0009: 0.7211, 0.0001: 0.6517, 0.0: 0.6483}
"""Table 1: the paper's epsilon^d."""

NUS = {0.02: 0.78, 0.03: 0.80, 0.04: 0.79, 0.05: 0.81}
TAUS: Mapping[float, float] = {10: 0.98, 30: 0.81, 50: 0.83, 100: 0.80}
"""Table 2: the paper's epsilon^d."""

DECAY = 0.998
"""Multiplier of epsilon throughout; the text leaves it open, decision 0013."""

STARTS = (1.2, 1.0)
"""Epsilon at first: the paper's, and the one that comes nearer to its tables, decision 0013."""

OTHER = f"epsilon from {STARTS[1]}"
"""Heading of the column for the second of them."""

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

NOISE = 0.02
"""Rise of epsilon^d from a sigma to a smaller one that is no more than its uncertainty."""

OLD, NEW = "101", "011"

PICTURED = (0.008, 0.0001)
"""The values of sigma that the paper shows a figure of."""

COLUMNS: Mapping[str, Mapping[float, float]] = {"sigma": SIGMAS, "nu": NUS, "tau": TAUS}
QUICK_COLUMNS = {"sigma": {sigma: SIGMAS[sigma] for sigma in (0.008, 0.0009, 0.0)}}


def plan(request: Request) -> list[dict[str, Any]]:
    """Tables 1 and 2, twice: 14 values of epsilon^c, 10 trials each, for every value of a key."""
    n = request.count(10, 3)
    changes = QUICK_CHANGES if request.quick else CHANGES
    return [
        {"key": key, "value": value, "start": start, "epsilon_c": epsilon, "seed": seed}
        for start in STARTS
        for key, values in (QUICK_COLUMNS if request.quick else COLUMNS).items()
        for value in values
        for epsilon in changes
        for seed in range(n)
    ]


def run(settings: Settings) -> Output:
    """Streams zero, x2, x3; the first becomes x1 when epsilon falls below epsilon^c."""
    config = learner_config(
        **{settings["key"]: settings["value"]},
        epsilon_start=settings["start"],
        epsilon_decay=DECAY,
        epsilon_tail_decay=DECAY,
        patience=1,
    )
    result = run_trial(
        config,
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


def point_of_no_return(trials: Sequence[Trial]) -> Midpoint:
    """Epsilon^d: the midpoint of "converged to the new optimum" against epsilon^c."""
    return logistic_midpoint(
        [t.settings["epsilon_c"] for t in trials], [_is_new(t) for t in trials]
    )


def evaluate(trials: Sequence[Trial]) -> Findings:
    """Late changes must leave the old optimum; epsilon^d must be lower for a smaller sigma."""
    by_start = {start: group for (start,), group in groups(trials, "start").items()}
    points = {start: _points(group) for start, group in by_start.items()}
    first, second = (points[start] for start in STARTS)
    lines: list[Line] = []
    for (key, value), group in groups(by_start[STARTS[0]], "key", "value").items():
        lines += _lines(key, value, group, first[key][value], second[key][value])
    sigma = first["sigma"]
    order = [_rank(sigma[s]) for s in sorted(sigma, reverse=True)]
    judged = _judged(by_start[STARTS[0]])
    smallest = groups(judged, "key", "value")["sigma", min(sigma)]
    largest = max(t.settings["epsilon_c"] for t in smallest)
    early = [t for t in smallest if t.settings["epsilon_c"] == largest]
    followed = sum(_is_new(t) for t in early)
    last = min(t.settings["epsilon_c"] for t in judged)
    late = groups(judged, "key", "epsilon_c")["sigma", last]
    kept = sum(not _is_new(t) for t in late)
    claims = [
        Claim(
            f"a change after {REWARDED} rewarded blocks and more is followed while epsilon is "
            "large, at the smallest sigma",
            followed >= 0.8 * len(early),
            f"{followed} of {len(early)} trials with epsilon^c = {largest:g}",
        ),
        Claim(
            "a change while epsilon is small is not followed",
            kept == len(late),
            f"{kept} of {len(late)} trials with epsilon^c = {last:g}",
        ),
        Claim(
            "epsilon^d is lower at the smallest sigma than at the largest, and nowhere rises",
            all(a >= b - NOISE for a, b in itertools.pairwise(order)) and order[0] > order[-1],
            _in_words(order),
        ),
    ]
    if "tau" in first:
        shortest, *others = (_rank(first["tau"][value]) for value in sorted(first["tau"]))
        claims.append(
            Claim(
                f"epsilon^d is higher at tau = {min(first['tau']):g} than at the others",
                all(shortest > v for v in others),
                _in_words([shortest, *others]),
            )
        )
    notes = [
        "A line without value: at no epsilon^c did most trials reach the new optimum, so "
        "epsilon^d lies above 1.",
        *(_unjudged(start, by_start[start], points[start]) for start in STARTS),
        *(_differences(start, points[start]) for start in STARTS),
    ]
    if "nu" in first:
        notes.append(CONTRADICTION)
    return Findings(lines, claims, notes)


Points = Mapping[str, Mapping[float, Midpoint]]
"""Epsilon^d by key and value."""


def _points(trials: Sequence[Trial]) -> Points:
    points: dict[str, dict[float, Midpoint]] = {}
    for (key, value), group in groups(trials, "key", "value").items():
        points.setdefault(key, {})[value] = point_of_no_return(group)
    return points


def _lines(
    key: str, value: float, group: Sequence[Trial], point: Midpoint, other: Midpoint
) -> list[Line]:
    """Epsilon^d, and how many of the trials from the first start end in neither optimum."""
    neither = float(np.mean([t.row["policy"] not in (OLD, NEW) for t in group]))
    pictured = key == "sigma" and value in PICTURED
    at = f"at {key} = {value:g}"
    return [
        Line(
            f"epsilon^d {at}",
            f"{COLUMNS[key][value]:g}",
            Summary(_shown(point), math.nan, point.n),
            (point.low, point.high),
            others={OTHER: (_shown(other), (other.low, other.high))},
        ),
        Line(
            f"share of trials in neither optimum {at}",
            "0 (figure)" if pictured else "0 (text)",
            Summary(neither, math.nan, len(group)),
        ),
    ]


def _shown(point: Midpoint) -> float:
    """Epsilon^d where it lies between the values of epsilon^c, else NaN."""
    return point.value if CHANGES[-1] <= point.value <= CHANGES[0] else math.nan


def _judged(trials: Sequence[Trial]) -> list[Trial]:
    """The trials of those epsilon^c before which blocks enough were rewarded, in the mean."""
    return [
        trial
        for group in groups(trials, "epsilon_c").values()
        if _rewarded(group) >= REWARDED
        for trial in group
    ]


def _rewarded(trials: Sequence[Trial]) -> float:
    return float(np.mean([t.row["rewarded"] for t in trials]))


def _unjudged(start: float, trials: Sequence[Trial], points: Points) -> str:
    """From which epsilon^c on there was little to follow a change from, in words."""
    least = max(t.settings["epsilon_c"] for t in _judged(trials))
    above = [
        f"{key} = {value:g}"
        for key, column in points.items()
        for value, point in column.items()
        if _rank(point) > least
    ]
    words = ", ".join(
        f"{epsilon:g}: {_rewarded(group):.0f}"
        for (epsilon,), group in groups(trials, "epsilon_c").items()
        if epsilon >= 0.7
    )
    return (
        f"Blocks rewarded before the change, epsilon from {start:g}, by epsilon^c: {words}. Above "
        f"{least:g} they are fewer than {REWARDED}, and the agent has hardly an optimum to leave: "
        f"a change there is not judged. Epsilon^d lies there at {', '.join(above) or 'none'}."
    )


def _is_new(trial: Trial) -> bool:
    return bool(trial.row["policy"] == NEW)


def _differences(start: float, points: Points) -> str:
    """How far from the paper's values ours are, and where our interval does not hold them."""
    distances = {
        key: np.mean([abs(min(_rank(p), 1.0) - COLUMNS[key][value]) for value, p in column.items()])
        for key, column in points.items()
    }
    found = [
        f"{key} = {value:g} ({_in_words([_rank(point)])} against {COLUMNS[key][value]:g})"
        for key, column in points.items()
        for value, point in column.items()
        if not point.low <= COLUMNS[key][value] <= point.high
    ]
    words = ", ".join(f"{distance:.3f} over {key}" for key, distance in distances.items())
    return (
        f"Epsilon from {start:g}: mean distance from the paper's values {words}, where above 1 "
        f"counts as 1. Beyond the 95 % interval: {', '.join(found) or 'none'}."
    )


def _in_words(values: Sequence[float]) -> str:
    return ", ".join("above 1" if v == 2.0 else f"{v:.3f}" for v in values)


def _rank(point: Midpoint) -> float:
    """Epsilon^d for comparison; 2 where it lies above every epsilon^c, 0 where below."""
    if math.isnan(point.value):
        return 2.0 if point.low == CHANGES[0] else 0.0
    return 2.0 if point.value > CHANGES[0] else point.value


def draw(trials: Sequence[Trial], folder: Path) -> list[Path]:
    """Policy against epsilon^c for the smallest and the largest sigma, grey where not judged."""
    by_sigma = {
        v: group
        for (k, v, start), group in groups(trials, "key", "value", "start").items()
        if k == "sigma" and start == STARTS[0]
    }
    sigmas = sorted(by_sigma)
    chosen = (0.0001 if 0.0001 in sigmas else sigmas[0], sigmas[-1])
    drawn, axes = panels.figure(1, 2)
    for panel, sigma, letter in zip(axes[0], chosen, "ab", strict=True):
        by_change = groups(by_sigma[sigma], "epsilon_c")
        epsilons = [epsilon for (epsilon,) in sorted(by_change)]
        policies = [[[*map(int, t.row["policy"])] for t in by_change[e,]] for e in epsilons]
        mean = np.array([np.mean(policy, axis=0) for policy in policies])
        for s, (marker, size) in enumerate(panels.MARKERS):
            panel.plot(
                epsilons,
                mean[:, s],
                marker=marker,
                markersize=size,
                linewidth=1,
                linestyle=panels.DASHES[s],
                color=panels.COLOURS[s],
                label=panels.STREAM_NAMES[s],
            )
        point = point_of_no_return(by_sigma[sigma])
        if math.isfinite(point.value):
            panel.axvline(
                point.value, color="grey", linestyle="-.", linewidth=1, label=r"$\epsilon^d$"
            )
        least = max(t.settings["epsilon_c"] for t in _judged(by_sigma[sigma]))
        panel.axvspan(least, max(epsilons), color="grey", alpha=0.15, linewidth=0)
        panel.legend(fontsize=6)
        panels.label(panel, letter, rf"$\epsilon^c$   ($\sigma$ = {sigma:g})", "policy, mean")
        panels.stay_to_switch(panel)
    return panels.save(drawn, folder, "nonstationary")
