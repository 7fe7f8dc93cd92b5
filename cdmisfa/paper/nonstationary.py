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

QUICK_CHANGES = (1.0, 0.9, 0.8, 0.7, 0.3)

SIGMAS = {0.008: 0.8933, 0.003: 0.8775, 0.0009: 0.7211, 0.0001: 0.6517, 0.0: 0.6483}
"""Table 1: the paper's epsilon^d."""

NUS = {0.02: 0.78, 0.03: 0.80, 0.04: 0.79, 0.05: 0.81}
TAUS: Mapping[float, float] = {10: 0.98, 30: 0.81, 50: 0.83, 100: 0.80}
"""Table 2: the paper's epsilon^d."""

DECAY = 0.998
"""Multiplier of epsilon throughout; the text leaves it open, decision 0013."""

NOISE = 0.02
"""Rise of epsilon^d from a sigma to a smaller one that is no more than its uncertainty."""

OLD, NEW = "101", "011"

COLUMNS: Mapping[str, Mapping[float, float]] = {"sigma": SIGMAS, "nu": NUS, "tau": TAUS}
QUICK_COLUMNS = {"sigma": {sigma: SIGMAS[sigma] for sigma in (0.008, 0.0009, 0.0)}}


def plan(request: Request) -> list[dict[str, Any]]:
    """Table 1, then table 2: 14 values of epsilon^c, 10 trials each, for every value of a key."""
    n = request.count(10, 3)
    changes = QUICK_CHANGES if request.quick else CHANGES
    return [
        {"key": key, "value": value, "epsilon_c": epsilon, "seed": seed}
        for key, values in (QUICK_COLUMNS if request.quick else COLUMNS).items()
        for value in values
        for epsilon in changes
        for seed in range(n)
    ]


def run(settings: Settings) -> Output:
    """Streams zero, x2, x3; the first becomes x1 when epsilon falls below epsilon^c."""
    config = learner_config(
        **{settings["key"]: settings["value"]},
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
    )
    policy = result.modules[0].policy if result.modules else result.final_policy
    row = {
        "policy": "".join(map(str, policy)),
        "saved": bool(result.modules),
        "iterations": result.iterations,
        "swapped": result.swapped,
    }
    return row, {}


def point_of_no_return(trials: Sequence[Trial]) -> Midpoint:
    """Epsilon^d: the midpoint of "converged to the new optimum" against epsilon^c."""
    return logistic_midpoint(
        [t.settings["epsilon_c"] for t in trials], [_is_new(t) for t in trials]
    )


def evaluate(trials: Sequence[Trial]) -> Findings:
    """Late changes must leave the old optimum; epsilon^d must be lower for a smaller sigma."""
    lines: list[Line] = []
    points: dict[str, dict[float, Midpoint]] = {}
    for (key, value), group in groups(trials, "key", "value").items():
        point = points.setdefault(key, {})[value] = point_of_no_return(group)
        inside = CHANGES[-1] <= point.value <= CHANGES[0]
        shown = Summary(point.value if inside else math.nan, math.nan, point.n)
        neither = float(np.mean([t.row["policy"] not in (OLD, NEW) for t in group]))
        at, bounds = f"at {key} = {value:g}", (point.low, point.high)
        share = Summary(neither, math.nan, len(group))
        lines += [
            Line(f"epsilon^d {at}", f"{COLUMNS[key][value]:g}", shown, bounds),
            Line(f"share of trials in neither optimum {at}", "0", share),
        ]
    sigma = points["sigma"]
    order = [_rank(sigma[s]) for s in sorted(sigma, reverse=True)]
    changes = [t.settings["epsilon_c"] for t in trials]
    early, last = groups(trials, "key", "value", "epsilon_c"), min(changes)
    followed = np.mean([_is_new(t) for t in early["sigma", min(sigma), max(changes)]])
    late = groups(trials, "key", "epsilon_c")["sigma", last]
    kept = sum(not _is_new(t) for t in late)
    claims = [
        Claim(
            "a change while epsilon is large is followed, at the smallest sigma",
            bool(followed >= 0.8),
            f"{followed:.0%} of the trials with epsilon^c = 1",
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
    if "tau" in points:
        shortest, *others = (_rank(points["tau"][value]) for value in sorted(points["tau"]))
        claims.append(
            Claim(
                f"epsilon^d is higher at tau = {min(points['tau']):g} than at the others",
                all(shortest > v for v in others),
                _in_words([shortest, *others]),
            )
        )
    notes = [
        "A line without value: at no epsilon^c did most trials reach the new optimum, so "
        "epsilon^d lies above 1.",
        *_differences(points),
    ]
    return Findings(lines, claims, notes)


def _is_new(trial: Trial) -> bool:
    return bool(trial.row["policy"] == NEW)


def _differences(points: Mapping[str, Mapping[float, Midpoint]]) -> list[str]:
    """Where our interval does not hold the paper's value, in words."""
    found = [
        f"{key} = {value:g} ({_in_words([_rank(point)])} against {COLUMNS[key][value]:g})"
        for key, column in points.items()
        for value, point in column.items()
        if not point.low <= COLUMNS[key][value] <= point.high
    ]
    if not found:
        return []
    return [f"Differs from the paper's value beyond the 95 % interval: {', '.join(found)}."]


def _in_words(values: Sequence[float]) -> str:
    return ", ".join("above 1" if v == 2.0 else f"{v:.3f}" for v in values)


def _rank(point: Midpoint) -> float:
    """Epsilon^d for comparison; 2 where it lies above every epsilon^c, 0 where below."""
    if math.isnan(point.value):
        return 2.0 if point.low == CHANGES[0] else 0.0
    return 2.0 if point.value > CHANGES[0] else point.value


def draw(trials: Sequence[Trial], folder: Path) -> list[Path]:
    """Policy against epsilon^c for the smallest and the largest sigma, and both tables."""
    by_sigma = {
        v: group for (k, v), group in groups(trials, "key", "value").items() if k == "sigma"
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
        panel.legend(fontsize=6)
        panels.label(panel, letter, rf"$\epsilon^c$   ($\sigma$ = {sigma:g})", "policy, mean")
        panels.stay_to_switch(panel)
    return panels.save(drawn, folder, "nonstationary")
