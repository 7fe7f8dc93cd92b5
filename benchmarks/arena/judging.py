"""One trial: run a learner on a set of streams, and judge its modules.

Modules are judged against batch SFA and against the true state of the world, on frames that the
learner did not see.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from benchmarks.arena.streams import CHANGE, SETS, ArenaSource, parse, slowest_output
from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.learning import Learner
from cdmisfa.experiments.loop import ending
from cdmisfa.experiments.results import correlation
from cdmisfa.modules import Module

SLOW_ENOUGH = 1.25
"""A learned output may be so many times as fast as batch SFA's slowest."""

KNOWS = 0.8
"""Correlation with batch SFA from which on a module knows a stream that it was not learned on."""

RIDGE = 1e-3
"""Penalty of the linear probe, as a share of the number of frames."""


class Saved(NamedTuple):
    """A module, the stream it was learned on, what that showed, and the blocks seen by then."""

    module: Module
    stream: int
    name: str
    learnable: bool
    block: int


@dataclass
class Course:
    """What happened in a run.

    Attributes:
        saved: the modules, in order.
        watched: of every block its first frame and its stream.
        rejected: blocks that each stream was watched until it was first rejected.
        ended: whether the learner ended by itself.
    """

    saved: list[Saved] = field(default_factory=list)
    watched: list[tuple[int, int]] = field(default_factory=list)
    rejected: dict[int, int] = field(default_factory=dict)
    ended: bool = False


def run_learner(learner: Learner, source: ArenaSource, name: str) -> Course:
    """Let a learner learn until it ends by itself, or the set's frames are over."""
    course, entry = Course(), SETS[name]
    while source.t < entry.get("frames", 240_000):
        if not entry.get("goes_on") and ending(learner, learner.max_modules, None):
            course.ended = True
            break
        block = source.take(learner.stream, learner.tau)
        learner.step(block)
        stream, showing = block.stream, source.showing(block.stream, source.t - 1)
        course.watched.append((block.t, stream))
        about = stream, showing.name, showing.learnable, len(course.watched)
        course.saved += [Saved(module, *about) for module in learner.modules[len(course.saved) :]]
        if any(f"{source.spec.streams[stream]} is rejected" in text for text in learner.events):
            visits = sum(watched == stream for _, watched in course.watched)
            course.rejected.setdefault(stream, visits)
    return course


def judge(course: Course, source: ArenaSource, components: int, expansion: str) -> dict[str, Any]:
    """Return the scores of a run as JSON values; None where a measure does not apply.

    Args:
        course: course of the run.
        source: the streams that it learned from.
        components: K of the batch SFA that modules are compared with.
        expansion: expansion of the batch SFA.
    """
    targets = _targets(course, source, (components, expansion))
    at = list(targets.values())
    never = [not any(showing.learnable for showing in phases) for phases in source.phases]
    right = [one.name for one in course.saved if one.learnable]
    wrong = [one.name for one in course.saved if not one.learnable]
    vain = [not source.showing(stream, t).learnable for t, stream in course.watched]
    return {
        "targets": targets,
        "noise": wrong,
        "learned": float(np.mean([block is not None for block in at])),
        "noise learned": len(wrong),
        "twice": len(right) - len(set(right)),
        "noise told": max((n for s, n in course.rejected.items() if never[s]), default=None),
        "in vain": float(np.mean(vain)),
        "ends": float(course.ended),
        "blocks": len(course.watched) if course.ended else None,
        "all learned": None if None in at else max(at),
        **_probes(course, source, (components, expansion)),
    }


def _targets(course: Course, source: ArenaSource, terms: tuple[int, str]) -> dict[str, int | None]:
    """Return the block by which each learnable stream was learned.

    That is by the first module that was learned on it and is slow enough. Where there is none, a
    module counts that is slow enough where it was learned, and here, and follows batch SFA here.
    """
    slow, knows = list[tuple[int, str]](), list[tuple[int, str]]()
    for name in filter(_is_learnable, source.footage):
        answer, reference = slowest_output(source.reference(name, *terms)[0], source.footage[name])
        for k, one in enumerate(course.saved):
            y, slowness = slowest_output(one.module, source.footage[name])
            if slowness <= SLOW_ENOUGH * reference:
                slow.append((k, name))
                knows += [(k, name)] if correlation(y, answer) > KNOWS else []
    sound = [k for k, one in enumerate(course.saved) if (k, one.name) in slow]
    targets: dict[str, int | None] = {}
    for stream, phases in enumerate(source.phases):
        for phase, showing in enumerate(phases):
            learned = [k for k in sound if course.saved[k].name == showing.name]
            by = learned or [k for k in sound if (k, showing.name) in knows]
            if showing.learnable:
                begins = sum(t < phase * CHANGE for t, _ in course.watched)
                name = f"{source.spec.streams[stream]} {phase}"
                targets[name] = max(begins, course.saved[by[0]].block) if by else None
    return targets


def _is_learnable(name: str) -> bool:
    return parse(name)[0].learnable


def _probes(course: Course, source: ArenaSource, terms: tuple[int, str]) -> dict[str, float | None]:
    """Return R^2 of the state by the modules of each stream, and by principal components."""
    r_squared = []
    for name, footage in source.footage.items():
        modules = [one.module for one in course.saved if one.name == name and one.learnable]
        if modules and footage.state.shape[1]:
            features = np.concatenate([m.transform(footage.frames) for m in modules], axis=1)
            leading = source.reference(name, *terms)[1].transform(footage.frames)
            n = min(features.shape[1], leading.shape[1])
            r_squared.append([probe(y[:, :n], footage.state) for y in (features, leading)])
    means = np.mean(r_squared, axis=0).tolist() if r_squared else (None, None)
    return dict(zip(("R2", "R2 of components"), means, strict=True))


def probe(features: FloatArray, state: FloatArray, labels: int | None = None) -> float:
    """Return how well a linear map predicts the state of the world from features, mean R^2.

    Ridge regression is fitted on the first three quarters of the frames and judged on the last.
    A constant part of the state is skipped, and one that is predicted worse than by its mean
    counts 0.

    Args:
        features: (n, J).
        state: (n, C).
        labels: number of the frames to fit that are used, spread evenly; None: all.
    """
    cut = 3 * len(state) // 4
    rows = np.linspace(0, cut - 1, labels or cut).round().astype(int)
    fitted, known = features[rows], state[rows]
    moves = (np.ptp(known, axis=0) > 0) & (np.ptp(state[cut:], axis=0) > 0)
    scale = fitted.std(axis=0)
    x = (features - fitted.mean(axis=0))[:, scale > 0] / scale[scale > 0]
    s = (state - known.mean(axis=0))[:, moves]
    gram = x[rows].T @ x[rows] + RIDGE * len(rows) * np.eye(x.shape[1])
    weights = np.linalg.solve(gram, x[rows].T @ s[rows])
    error = ((s[cut:] - x[cut:] @ weights) ** 2).sum(axis=0)
    total = ((s[cut:] - s[cut:].mean(axis=0)) ** 2).sum(axis=0)
    return float(np.maximum(1 - error / total, 0).mean())
