"""One trial: a learner on a set of streams, and what came of it.

That is which streams it learned, what it learned in vain, and what that tells of the world.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cdmisfa.agents.learners import open_learner
from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.learning import Learner
from cdmisfa.core.modules import Module
from cdmisfa.experiments.loop import ending
from cdmisfa.experiments.results import correlation
from cdmisfa.experiments.store import StoredTrial
from cdmisfa.features.sfa import slowness
from cdmisfa.studies.arena.library import ArenaSource, Library, Reference
from cdmisfa.studies.arena.pictures import Footage
from cdmisfa.studies.arena.streams import ArenaSet, parse

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


@dataclass(frozen=True, slots=True, kw_only=True)
class ArenaTrial(StoredTrial):
    """A learner on a set, and everything a worker needs to compute it.

    Its point is the names of set and learner, and what else was set; its seed is that of the
    learner and of the streams.

    Attributes:
        streams: the set.
        learner: the configuration.
        library: folder of the streams.
    """

    streams: ArenaSet
    learner: Any
    library: Path

    @property
    def reference(self) -> tuple[int, str]:
        """Components and expansion of the batch SFA that it is compared with.

        Where the learner leaves the expansion open: none of pictures, and quadratic else.
        """
        expansion = self.learner.expansion or ("none" if self.streams.images else "quadratic")
        return self.learner.components, expansion


@dataclass(frozen=True, slots=True)
class SavedModule:
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
class Course:
    """What happened in a run.

    Attributes:
        saved: the modules, in order.
        watched: of every block, the frame at which it begins and its stream.
        frames: how many were seen.
        ended: why the learner ended by itself, a key of `ENDINGS`; "" where it did not, None
            where it was not asked.
    """

    saved: Sequence[SavedModule]
    watched: Sequence[tuple[int, int]]
    frames: int
    ended: str | None


def run_arena_trial(trial: ArenaTrial) -> dict[str, Any]:
    """Compute a trial from streams that were made before: its row, as JSON values."""
    library = Library(trial.library)
    with contextlib.closing(ArenaSource(trial.streams.words, library, trial.seed)) as source:
        learner = open_learner(trial.learner, source.spec, trial.seed)
        course = run_learner(learner, source, trial.streams.frames, goes_on=trial.streams.goes_on)
        learnable = [name for name in source.streams if parse(name)[0].learnable]
        references = {n: library.reference(n, trial.seed, *trial.reference) for n in learnable}
        return Judge(course, source, references).row()


def run_learner(learner: Learner, source: ArenaSource, frames: int, *, goes_on: bool) -> Course:
    """Let a learner learn until it ends by itself, or the frames are over.

    Args:
        learner: at its beginning.
        source: at its beginning.
        frames: after so many it is stopped.
        goes_on: it is not asked whether it wants to end.
    """
    saved: list[SavedModule] = []
    watched: list[tuple[int, int]] = []
    ended = ""
    while source.t < frames:
        if not goes_on and (ended := ending(learner, learner.max_modules, None)):
            break
        block = source.take(learner.stream, learner.tau)
        learner.step(block)
        watched.append((block.t, block.stream))
        shown = source.shown(block.stream, source.t - 1)
        about = block.stream, shown.name, shown.learnable, source.t, len(watched)
        saved += [SavedModule(module, *about) for module in learner.modules[len(saved) :]]
    return Course(saved, watched, source.t, None if goes_on else ended)


def slowest_output(module: Module, frames: NDArray[Any]) -> tuple[FloatArray, float]:
    """The slowest output of a module on frames, (n,), and its slowness.

    That is infinite where the output does not vary.
    """
    y = module.transform(frames)
    still = y.max(axis=0) == y.min(axis=0)
    eta = np.full(y.shape[1], math.inf)
    eta[~still] = slowness(y[:, ~still])
    first = int(np.argmin(eta))
    return y[:, first], float(eta[first])


def allowed_slowness(stream: Footage, reference: Reference) -> float:
    """The slowness up to which a stream counts as learned."""
    return reference.slowness * (SLOW_ENOUGH_LOOPED if stream.loops else SLOW_ENOUGH)


class Judge:
    """What a run came to.

    Args:
        course: of the run.
        source: what it learned from.
        references: by signal, of those that are learnable.
    """

    def __init__(
        self, course: Course, source: ArenaSource, references: Mapping[str, Reference]
    ) -> None:
        self._course, self._source, self._references = course, source, references
        self._streams = source.streams
        self._outputs: dict[tuple[int, str], tuple[FloatArray, float]] = {}

    def row(self) -> dict[str, Any]:
        """All of it, as JSON values."""
        course = self._course
        return {
            "frames": course.frames,
            "blocks": len(course.watched),
            "ended": course.ended,
            "targets": self._targets(),
            "modules": [
                {
                    "stream": self._source.spec.streams[one.stream],
                    "signal": one.signal,
                    "learnable": one.learnable,
                    "frame": one.frame,
                    "block": one.block,
                    "slowness": self._output(k, one.signal)[1],
                    "allowed": self._allowed(one.signal) if one.learnable else None,
                }
                for k, one in enumerate(course.saved)
            ],
            "wrong": sum(not one.learnable for one in course.saved),
            "doubles": sum(self._double(k) for k in range(len(course.saved))),
            "probes": self._probes(),
        }

    def _output(self, k: int, signal: str) -> tuple[FloatArray, float]:
        """The slowest output of module k on a signal's held-out frames, and its slowness."""
        if (k, signal) not in self._outputs:
            module, frames = self._course.saved[k].module, self._streams[signal].held_out
            self._outputs[k, signal] = slowest_output(module, frames)
        return self._outputs[k, signal]

    def _allowed(self, signal: str) -> float:
        return allowed_slowness(self._streams[signal], self._references[signal])

    @cached_property
    def _sound(self) -> list[int]:
        """The modules that are slow enough on the learnable signal they were learned on."""
        saved = self._course.saved
        return [k for k, s in enumerate(saved) if s.learnable and self._slow(k, s.signal)]

    def _slow(self, k: int, signal: str) -> bool:
        return self._output(k, signal)[1] <= self._allowed(signal)

    def _knows(self, k: int, signal: str) -> bool:
        """Whether a module's output on a signal is slow, and that of batch SFA."""
        slowest = self._references[signal].slowest
        answer = slowest.transform(self._streams[signal].held_out)[:, 0]
        return self._slow(k, signal) and correlation(self._output(k, signal)[0], answer) > KNOWS

    def _learned(self, signal: str) -> SavedModule | None:
        """The first module of a learnable signal, if any.

        That is one that was learned on it and is slow enough. Where there is none, one counts
        that is slow enough where it was learned and knows this signal, too.
        """
        saved, sound = self._course.saved, self._sound
        own = [k for k in sound if saved[k].signal == signal]
        found = own or [k for k in sound if self._knows(k, signal)]
        return saved[found[0]] if found else None

    def _double(self, k: int) -> bool:
        """Whether a module is too many: the stream shows the same and has one already.

        Where it is another stream on which the same is shown, too, it counts if the output is
        the same.
        """
        saved = self._course.saved
        one = saved[k]
        for j, other in enumerate(saved[:k]):
            if other.signal != one.signal:
                continue
            outputs = (self._output(i, one.signal)[0] for i in (j, k))
            if other.stream == one.stream or correlation(*outputs) > THE_SAME:
                return True
        return False

    def _targets(self) -> list[dict[str, Any]]:
        """For everything that could be learned: when it was, and after how many blocks of it."""
        found = []
        for stream, phases in enumerate(self._source.phases):
            for phase, showing in enumerate(phases):
                if not showing.learnable:
                    continue
                begins, module = self._source.begins(phase), self._learned(showing.name)
                target = {"stream": self._source.spec.streams[stream], "signal": showing.name}
                when: dict[str, Any] = dict.fromkeys(("frame", "block", "watched"))
                if module is not None:
                    frame = max(begins, module.frame)
                    until = [(t, s) for t, s in self._course.watched if t < frame]
                    of_it = sum(s == stream and t >= begins for t, s in until)
                    when = {"frame": frame, "block": len(until), "watched": of_it}
                found.append(target | when)
        return found

    def _probes(self) -> list[dict[str, Any]]:
        """What the modules of each signal tell of the world, against principal components."""
        found = []
        for name, reference in self._references.items():
            stream = self._streams[name]
            modules = [one.module for one in self._course.saved if one.signal == name]
            if not modules or not stream.state.shape[1]:
                continue
            own = np.concatenate([m.transform(stream.frames) for m in modules], axis=1)
            leading = reference.components.transform(stream.frames)
            n = min(own.shape[1], leading.shape[1])
            told = [probe(features[:, :n], stream.state) for features in (own, leading)]
            found.append({"signal": name, "outputs": n, "modules": told[0], "components": told[1]})
        return found


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
