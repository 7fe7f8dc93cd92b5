"""Columns of joint states and actions: how far joints move, and whether the states follow."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray, IntArray
from replay.episodes.measure import Measured

# Largest standard deviation of the differences of a number over that of the number itself: white
# noise has 1.4, and says nothing of motion.
NOISE: Final = 0.9

# Quantile of the motion in a step that a larger step counts as: the command of a gripper jumps.
CAP: Final = 0.95

# Share of a joint's median step below which its state stands still: encoders have some noise.
STILL: Final = 0.05

# Share of the motion behind rows that are the same at which it starts mattering.
STARTED: Final = 0.1

# For each episode the times (N,) and the numbers (N, n).
Numbers = list[tuple[FloatArray, FloatArray]]


class Column(NamedTuple):
    """One measure of each of n episodes.

    Attributes:
        reason: key of `REASONS`.
        camera: the camera, or "".
        compared: (n,) value that is compared between episodes, higher is worse; NaN: not judged.
        value: (n,) the same in the unit that the reason is stated in.
        at: (n,) time in the episode (s); NaN if it holds for all of the episode.
    """

    reason: str
    camera: str
    compared: FloatArray
    value: FloatArray
    at: FloatArray


def column(reason: str, compared: Any, value: Any = None, at: Any = None) -> Column:
    """Return a column, by default stated as it is compared, and of no special time."""
    compared = np.asarray(compared, np.float64)
    value = compared if value is None else np.asarray(value, np.float64)
    at = np.full(len(compared), np.nan) if at is None else np.asarray(at, np.float64)
    return Column(reason, "", compared, value, at)


def scaled(episodes: Sequence[Measured], kind: str) -> Numbers | None:
    """Return numbers in their standard deviations; None if they differ, or are all noise."""
    if not all(kind in episode.numbers for episode in episodes):
        return None
    numbers = [episode.numbers[kind] for episode in episodes]
    if len({values.shape[1] for _, values in numbers}) > 1:
        return None
    deviation = np.concatenate([values for _, values in numbers]).std(0)
    steps = np.concatenate([np.diff(values, axis=0) for _, values in numbers])
    if not len(steps):
        return None
    moving = (deviation > 1e-9) & (steps.std(0) < NOISE * deviation)
    scaled = [(times, values[:, moving] / deviation[moving]) for times, values in numbers]
    return scaled if moving.any() else None


def paths(moving: Numbers) -> tuple[list[FloatArray], float]:
    """Return the path of the joints up to each row, (N,) for each episode, and the typical speed.

    p[j] = sum over i <= j of min(|a[i] - a[i-1]|, its 0.95 quantile in all episodes)
    """
    steps = [np.linalg.norm(np.diff(x, axis=0, prepend=x[:1]), axis=1) for _, x in moving]
    cap = float(np.quantile(np.concatenate(steps), CAP))
    steps = [np.minimum(part, cap) for part in steps]
    gaps = [np.maximum(np.diff(times), 1e-9) for times, _ in moving]
    speeds = np.concatenate([part[1:] / gap for part, gap in zip(steps, gaps, strict=True)])
    return [np.cumsum(part) for part in steps], float(np.median(speeds)) + 1e-9


def number_columns(episodes: Sequence[Measured]) -> list[Column]:
    """Return the columns of durations, and of joint states and actions if all episodes have them.

    short = -log T
    idle = -log(p[N] / median p[N] + 0.01)
    jump = log max |x''|
    noise = log max over joints of the median of |x''| over time

    Equation: E1
    Equation: E2
    Equation: E17
    Equation: E18
    """
    seconds = np.array([max(episode.seconds, 1e-3) for episode in episodes])
    columns = [column("short", -np.log(seconds), seconds)]
    state, action = scaled(episodes, "state"), scaled(episodes, "action")
    if moving := action or state:
        length = np.array([path[-1] for path in paths(moving)[0]])
        length /= np.median(length) + 1e-9
        columns.append(column("idle", -np.log(length + 0.01), length))
    if state:
        bends = [np.abs(np.diff(np.pad(x, ((1, 1), (0, 0)), "edge"), 2, 0)) for _, x in state]
        jumps = np.array([part[1:-1].max(initial=0) for part in bends])
        at = [times[part.max(1).argmax()] for (times, _), part in zip(state, bends, strict=True)]
        noise = np.array([np.median(part, axis=0).max() for part in bends])
        columns += [column("jump", np.log(jumps + 1e-6), jumps, at)]
        columns += [column("noise", np.log(noise + 1e-6), noise)]
    return columns + (_following(episodes) if state and action else [])


def _following(episodes: Sequence[Measured]) -> list[Column]:
    """Return how far states are from actions, and the motion commanded of a state that is stuck.

    state = log of the 0.9 quantile over time of mean |x - a| / sd x
    stuck = largest sum of |a[i] - a[i-1]| / sd a over rows with equal x, of any joint

    Equation: E15
    Equation: E16
    """
    clocks, states, actions = [], [], []
    for episode in episodes:
        (times, state), (clock, action) = episode.numbers["state"], episode.numbers["action"]
        if state.shape[1] != action.shape[1]:
            return []
        clocks.append(times)
        states.append(state)
        actions.append(np.stack([np.interp(times, clock, x) for x in action.T], axis=1))
    units = [np.concatenate(parts).std(0) + 1e-9 for parts in (states, actions)]
    still = STILL * np.median(np.concatenate([np.abs(np.diff(x, axis=0)) for x in states]), axis=0)
    apart, at, stuck, begins = [], [], [], []
    for times, state, action in zip(clocks, states, actions, strict=True):
        error = (np.abs(state - action) / units[0]).mean(1)
        apart.append(np.log(np.quantile(error, 0.9) + 1e-6))
        at.append(times[error.argmax()])
        steps = np.abs(np.diff(action, axis=0, prepend=action[:1])) / units[1]
        same = np.abs(np.diff(state, axis=0, prepend=state[:1] - 1)) <= still
        hidden, first = longest(same, steps)
        stuck.append(hidden.max())
        begins.append(times[first[hidden.argmax()]])
    return [column("state", apart, np.exp(apart), at), column("stuck", stuck, at=begins)]


def longest(same: NDArray[np.bool_], motion: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the largest motion within rows that are the same, and the row where it begins.

    Args:
        same: (T, n) whether a row equals the one before.
        motion: (T, n) the motion in each row.
    """
    total = np.cumsum(np.where(same, motion, 0), axis=0)
    rows = np.arange(len(same))[:, None]
    start = np.maximum.accumulate(np.where(same, -1, rows), axis=0)
    before = np.where(start >= 0, np.take_along_axis(total, np.maximum(start, 0), axis=0), 0)
    run = total - before
    last = run.argmax(0)[None]
    most = np.take_along_axis(run, last, 0)[0]
    inside = (start == np.take_along_axis(start, last, 0)) & (run >= STARTED * most)
    return most, inside.argmax(0)
