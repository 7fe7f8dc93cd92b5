"""What a run is worth: which streams it learned, what it learned in vain, what that tells."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cdmisfa.arena.library import Reference, Stream
from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.modules import Module
from cdmisfa.experiments.statistics import correlation
from cdmisfa.features.sfa import slowness

SLOW_ENOUGH: Final = 1.25
"""A learned output may be so many times as fast as the slowest that batch SFA finds."""

SLOW_ENOUGH_LOOPED: Final = 1.5
"""The same for short clips, on which the cut where they begin again weighs much."""

KNOWS: Final = 0.8
"""Correlation with batch SFA from which on a module knows a stream that it was not learned on."""

THE_SAME: Final = 0.9
"""Correlation above which modules of a stream shown twice are the same one."""

RIDGE: Final = 1e-3
"""Penalty of the linear probe, as a share of the number of frames."""


@dataclass(frozen=True, slots=True)
class Saved:
    """A module, and when it was learned.

    Attributes:
        stream: index of the stream that was watched when it was saved.
        signal: name of what that showed.
        learnable: whether there was anything to be learned.
        frame: frames seen by then.
        block: blocks seen by then.
    """

    module: Module
    stream: int
    signal: str
    learnable: bool
    frame: int
    block: int


@dataclass(frozen=True, slots=True)
class Output:
    """The slowest output of a module on some frames.

    Attributes:
        values: (n,).
        slowness: infinite where it does not vary.
    """

    values: FloatArray
    slowness: float


def slowest(module: Module, frames: NDArray[Any]) -> Output:
    """The slowest output of a module on frames, (n, *frame_shape)."""
    y = module.transform(frames)
    still = y.max(axis=0) == y.min(axis=0)
    eta = np.full(y.shape[1], math.inf)
    eta[~still] = slowness(y[:, ~still])
    first = int(np.argmin(eta))
    return Output(y[:, first], float(eta[first]))


def allowed(stream: Stream, reference: Reference) -> float:
    """The slowness up to which a stream counts as learned."""
    return reference.slowness * (SLOW_ENOUGH_LOOPED if stream.loops else SLOW_ENOUGH)


def learned(
    saved: Sequence[Saved],
    output: Callable[[int, str], Output],
    streams: Mapping[str, Stream],
    references: Mapping[str, Reference],
) -> dict[str, list[int]]:
    """The modules of each learnable signal: those that were learned on it and are slow enough.

    Where there is none, those count that are slow enough where they were learned and on this
    signal, too, and whose output on it is that of batch SFA.

    Args:
        saved: the modules, in order.
        output: the slowest output of a module, by its place, on a signal's held-out frames.
        streams: by signal.
        references: by signal, of the learnable ones.
    """

    def slow(k: int, name: str) -> bool:
        return output(k, name).slowness <= allowed(streams[name], references[name])

    def knows(k: int, name: str) -> bool:
        answer = references[name].slowest.transform(streams[name].held_out)[:, 0]
        return slow(k, name) and correlation(output(k, name).values, answer) > KNOWS

    sound = [k for k, one in enumerate(saved) if one.learnable and slow(k, one.signal)]
    return {
        name: [k for k in sound if saved[k].signal == name] or [k for k in sound if knows(k, name)]
        for name in references
    }


def doubles(saved: Sequence[Saved], output: Callable[[int, str], Output]) -> list[int]:
    """Which modules are too many: a stream that shows the same has one already.

    Where it is another stream on which the same is shown, too, those count whose output is the
    same.

    Args:
        saved: the modules, in order.
        output: the slowest output of a module, by its place, on a signal's held-out frames.
    """

    def same(k: int, j: int) -> bool:
        if saved[j].signal != saved[k].signal:
            return False
        if saved[j].stream == saved[k].stream:
            return True
        values = (output(i, saved[k].signal).values for i in (j, k))
        return correlation(*values) > THE_SAME

    return [k for k in range(len(saved)) if any(same(k, j) for j in range(k))]


def probe(features: FloatArray, state: FloatArray) -> float:
    """How well a linear map tells the state of the world from features.

    Ridge regression is fitted on the first three quarters of the frames and judged on the last.
    A part of the state that stands still in either is left out, and one that is told worse than
    by its mean counts 0.

    Args:
        features: (n, J).
        state: (n, C).

    Returns:
        Mean R^2 over the parts of the state, NaN where none is left.
    """
    cut = 3 * len(state) // 4
    moves = (np.ptp(state[:cut], axis=0) > 0) & (np.ptp(state[cut:], axis=0) > 0)
    if not moves.any():
        return math.nan
    x = features - features[:cut].mean(axis=0)
    scale = x[:cut].std(axis=0)
    x = x[:, scale > 0] / scale[scale > 0]
    s = state[:, moves] - state[:cut, moves].mean(axis=0)
    gram = x[:cut].T @ x[:cut] + RIDGE * cut * np.eye(x.shape[1])
    weights = np.linalg.solve(gram, x[:cut].T @ s[:cut])
    error = ((s[cut:] - x[cut:] @ weights) ** 2).sum(axis=0)
    total = ((s[cut:] - s[cut:].mean(axis=0)) ** 2).sum(axis=0)
    return float(np.maximum(1 - error / total, 0).mean())
