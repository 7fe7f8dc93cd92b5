"""One trial: a learner on a set of streams, and what came of it.

That is which streams it learned, what it learned in vain, and what that tells of the world.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cdmisfa.agents.learners import open_learner
from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.learning import Learner
from cdmisfa.experiments.loop import ending
from cdmisfa.experiments.results import correlation
from cdmisfa.experiments.store import StoredTrial
from cdmisfa.features.sfa import slowness
from cdmisfa.modules import Module
from cdmisfa.studies.arena.library import ArenaSource, Library, Reference
from cdmisfa.studies.arena.pictures import FITTED, FOLLOWING, PARTS, Footage, Part
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
        given_up: blocks of each stream that was given up, watched until it first was.
        decided: whenever a stream was learned or known: frames seen by then, the stream, and the
            index of the module that gives it.
        frames: how many were seen.
        ended: why the learner ended by itself, a key of `ENDINGS`; "" where it did not, None
            where it was not asked.
    """

    saved: Sequence[SavedModule]
    watched: Sequence[tuple[int, int]]
    given_up: Mapping[int, int]
    decided: Sequence[tuple[int, int, int]]
    frames: int
    ended: str | None


def run_arena_trial(trial: ArenaTrial) -> dict[str, Any]:
    """Compute a trial from streams that were made before: its row, as JSON values."""
    library = Library(trial.library)
    with contextlib.closing(ArenaSource(trial.streams.words, library, trial.seed)) as source:
        learner = open_learner(trial.learner, source.spec, trial.seed)
        course = run_learner(learner, source, trial.streams)
        learnable = [name for name in source.streams if parse(name)[0].learnable]
        references = {n: library.reference(n, trial.seed, *trial.reference) for n in learnable}
        return Judge(course, source, references).row()


def run_learner(learner: Learner, source: ArenaSource, streams: ArenaSet) -> Course:
    """Let a learner learn until it ends by itself, or the frames are over.

    Args:
        learner: at its beginning.
        source: at its beginning.
        streams: the set, which says how long, and what it costs to look elsewhere.
    """
    saved: list[SavedModule] = []
    watched: list[tuple[int, int]] = []
    given_up: dict[int, int] = {}
    decided: list[tuple[int, int, int]] = []
    visits = np.zeros(len(streams.words), dtype=int)
    ended = ""
    while source.t < streams.frames:
        if not streams.goes_on and (ended := ending(learner, learner.max_modules, None)):
            break
        block = source.take(learner.stream, learner.tau)
        learner.step(block)
        watched.append((block.t, block.stream))
        visits[block.stream] += 1
        # Told by its event: the state is not kept where all that was given up is looked at again.
        name = f"stream {streams.words[block.stream]} "
        if told := [text for text in learner.events if text.startswith(name)]:
            if told[0].startswith(f"{name}is given up"):
                given_up.setdefault(block.stream, int(visits[block.stream]))
            row = learner.summary().get("streams", {block.stream: {}})[block.stream]
            if row.get("state") in ("learned", "known"):
                decided.append((source.t, block.stream, row["module"] - 1))
        shown = source.shown(block.stream, source.t - 1)
        about = block.stream, shown.name, shown.learnable, source.t, len(watched)
        saved += [SavedModule(module, *about) for module in learner.modules[len(saved) :]]
        if learner.stream != block.stream:
            source.seek(source.t + streams.switch_cost)
    return Course(saved, watched, given_up, decided, source.t, None if streams.goes_on else ended)


def slowest_output(module: Module, frames: NDArray[Any]) -> tuple[FloatArray, float]:
    """What a module says is its slowest output, its first, on frames, (n,), and its slowness.

    That is infinite where the output does not vary.
    """
    y = module.transform(frames)[:, 0]
    return y, float(slowness(y[:, None])[0]) if y.max() > y.min() else math.inf


def allowed_slowness(stream: Footage, reference: Reference, part: Part) -> float:
    """The slowness on a part of its frames up to which a stream counts as learned."""
    return reference.slowness[part] * (SLOW_ENOUGH_LOOPED if stream.loops else SLOW_ENOUGH)


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
        self._outputs: dict[tuple[int, str, Part], tuple[FloatArray, float]] = {}

    def row(self) -> dict[str, Any]:
        """All of it, as JSON values."""
        course = self._course
        return {
            "frames": course.frames,
            "blocks": len(course.watched),
            "ended": course.ended,
            "targets": self._targets(),
            "modules": [self._of_module(k) for k in range(len(course.saved))],
            "wrong": sum(not one.learnable for one in course.saved),
            "doubles": sum(self._double(k) for k in range(len(course.saved))),
            "in_vain": self._in_vain(),
            "told": self._told(),
            "pairs": self._pairs(),
            "probes": self._probes(),
        }

    def _of_module(self, k: int) -> dict[str, Any]:
        """A module: slowness on the frames that follow and on those fitted to, and batch SFA's."""
        one = self._course.saved[k]
        found: dict[str, Any] = {
            "stream": self._source.spec.streams[one.stream],
            "signal": one.signal,
            "learnable": one.learnable,
            "frame": one.frame,
            "block": one.block,
        }
        for part in PARTS:
            batch = self._references[one.signal].slowness[part] if one.learnable else None
            found |= {part: self._output(k, one.signal, part)[1], f"{part}_of_batch": batch}
        return found

    def _in_vain(self) -> float:
        """Share of the blocks on what cannot be learned."""
        watched, source = self._course.watched, self._source
        vain = sum(not source.shown(stream, t).learnable for t, stream in watched)
        return vain / len(watched) if watched else 0.0

    def _told(self) -> dict[str, int]:
        """Blocks of each stream that never can be learned, until it was said to be so."""
        never = [not any(s.learnable for s in phases) for phases in self._source.phases]
        names = self._source.spec.streams
        return {names[s]: blocks for s, blocks in self._course.given_up.items() if never[s]}

    def _pairs(self) -> dict[str, list[bool]]:
        """Whether one module gives both, of pairs of streams that show one world or others.

        One world is seen from two sides; of others every pair counts, whatever sees them.
        """
        by = {stream: module for _, stream, module in self._course.decided}
        found: dict[str, list[bool]] = {"one": [], "others": []}
        steady = [(s, p[0]) for s, p in enumerate(self._source.phases) if len(p) == 1]
        for (a, this), (b, that) in itertools.combinations(steady, 2):
            merged = a in by and by[a] == by.get(b)
            if not (this.learnable and that.learnable):
                continue
            if this.kind != that.kind:
                found["others"].append(merged)
            elif this.sided and that.sided and this.camera != that.camera:
                found["one"].append(merged)
        return found

    def _output(self, k: int, signal: str, part: Part = FOLLOWING) -> tuple[FloatArray, float]:
        """Module k's first output on a part of a signal's frames, and its slowness."""
        if (k, signal, part) not in self._outputs:
            module, frames = self._course.saved[k].module, self._streams[signal].part(part)
            self._outputs[k, signal, part] = slowest_output(module, frames)
        return self._outputs[k, signal, part]

    def _sound(self, part: Part) -> list[int]:
        """The modules that are slow enough on the learnable signal they were learned on."""
        saved = self._course.saved
        return [k for k, s in enumerate(saved) if s.learnable and self._slow(k, s.signal, part)]

    def _slow(self, k: int, signal: str, part: Part) -> bool:
        allowed = allowed_slowness(self._streams[signal], self._references[signal], part)
        return self._output(k, signal, part)[1] <= allowed

    def _knows(self, k: int, signal: str, part: Part) -> bool:
        """Whether a module's output on a signal is slow, and that of batch SFA."""
        slowest = self._references[signal].slowest
        answer = slowest.transform(self._streams[signal].part(part))[:, 0]
        mine = self._output(k, signal, part)[0]
        return self._slow(k, signal, part) and correlation(mine, answer) > KNOWS

    def _learned(self, signal: str, part: Part) -> SavedModule | None:
        """The first module of a learnable signal, if any, as a part of its frames tells.

        That is one that was learned on it and is slow enough. Where there is none, one counts
        that is slow enough where it was learned and knows this signal, too.
        """
        saved, sound = self._course.saved, self._sound(part)
        own = [k for k in sound if saved[k].signal == signal]
        found = own or [k for k in sound if self._knows(k, signal, part)]
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
                begins = self._source.begins(phase)
                module = self._learned(showing.name, FOLLOWING)
                target = {
                    "stream": self._source.spec.streams[stream],
                    "signal": showing.name,
                    "fitted": self._learned(showing.name, FITTED) is not None,
                }
                when: dict[str, Any] = dict.fromkeys(("frame", "block", "watched", "known"))
                if module is not None:
                    by = module.module.index - 1
                    said = (t for t, *what in self._course.decided if what == [stream, by])
                    frame = next((t for t in said if t > begins), max(begins, module.frame))
                    until = [(t, s) for t, s in self._course.watched if t < frame]
                    of_it = sum(s == stream and t >= begins for t, s in until)
                    when = {"frame": frame, "block": len(until), "watched": of_it}
                    when["known"] = module.signal != showing.name
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
