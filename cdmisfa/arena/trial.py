"""One trial: a learner on a set of streams, and what came of it."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from cdmisfa.agents.learners import open_learner
from cdmisfa.arena.library import Library, Reference, Wanted
from cdmisfa.arena.measures import (
    Output,
    Saved,
    allowed,
    doubles,
    learned,
    probe,
    slowest,
)
from cdmisfa.arena.sets import ArenaSet
from cdmisfa.arena.source import ArenaSource
from cdmisfa.arena.streams import parse
from cdmisfa.core.learning import Learner
from cdmisfa.experiments.loop import ending


@dataclass(frozen=True, slots=True)
class ArenaTrial:
    """A learner on a set, and everything a worker needs to compute it.

    Attributes:
        id: hash of all it depends on.
        point: the names of set and learner, and what else was set.
        seed: of the learner and of the streams.
        streams: the set.
        learner: the configuration.
        library: folder of the streams.
        code: version of the code that the hash is about; workers must have the same.
    """

    id: str
    point: Mapping[str, str]
    seed: int
    streams: ArenaSet
    learner: Any
    library: Path
    code: str

    @property
    def log(self) -> None:
        """A trial of the arena keeps no log."""

    @property
    def reference(self) -> tuple[int, str]:
        """Components and expansion of the batch SFA that it is compared with.

        Where the learner leaves the expansion open: none of pictures, and quadratic else.
        """
        expansion = self.learner.expansion or ("none" if self.streams.images else "quadratic")
        return self.learner.components, expansion

    def wanted(self) -> list[Wanted]:
        """What it wants of the library, what others are made from first."""
        names = {signal.name for word in self.streams.words for signal in parse(word)}
        return [Wanted(name, self.seed, (self.reference,)) for name in sorted(names)]


@dataclass(frozen=True, slots=True)
class History:
    """What happened in a run.

    Attributes:
        saved: the modules, in order.
        watched: of every block, the frame at which it begins and its stream.
        frames: how many were seen.
        ended: why the learner ended by itself, a key of `ENDINGS`; "" where it did not, None
            where it was not asked.
    """

    saved: Sequence[Saved]
    watched: Sequence[tuple[int, int]]
    frames: int
    ended: str | None


def follow(learner: Learner, source: ArenaSource, frames: int, *, goes_on: bool) -> History:
    """Let a learner learn until it ends by itself, or the frames are over.

    Args:
        learner: at its beginning.
        source: at its beginning.
        frames: after so many it is stopped.
        goes_on: it is not asked whether it wants to end.
    """
    saved: list[Saved] = []
    watched: list[tuple[int, int]] = []
    ended = ""
    while source.t < frames:
        if not goes_on and (ended := ending(learner, learner.max_modules, None)):
            break
        block = source.take(learner.stream, learner.tau)
        learner.step(block)
        watched.append((block.t, block.stream))
        for module in learner.modules[len(saved) :]:
            shown = source.shown(block.stream, source.t - 1)
            saved.append(
                Saved(module, block.stream, shown.name, shown.learnable, source.t, len(watched))
            )
    return History(saved, watched, source.t, None if goes_on else ended)


def run_trial(trial: ArenaTrial) -> dict[str, Any]:
    """Compute a trial from streams that were made before: its row, as JSON values."""
    library = Library(trial.library)
    with contextlib.closing(ArenaSource(trial.streams.words, library, trial.seed)) as source:
        learner = open_learner(trial.learner, source.spec, trial.seed)
        history = follow(learner, source, trial.streams.frames, goes_on=trial.streams.goes_on)
        references = {
            name: library.reference(name, trial.seed, *trial.reference)
            for name in source.streams
            if parse(name)[0].learnable
        }
        return judge(history, source, references)


def judge(
    history: History, source: ArenaSource, references: Mapping[str, Reference]
) -> dict[str, Any]:
    """What a run came to, as JSON values.

    Args:
        history: of the run.
        source: what it learned from.
        references: by signal, of those that are learnable.
    """

    @cache
    def output(k: int, signal: str) -> Output:
        return slowest(history.saved[k].module, source.streams[signal].held_out)

    of_signal = learned(history.saved, output, source.streams, references)
    return {
        "frames": history.frames,
        "blocks": len(history.watched),
        "ended": history.ended,
        "targets": _targets(history, source, of_signal),
        "modules": [
            {
                "stream": source.spec.streams[one.stream],
                "signal": one.signal,
                "learnable": one.learnable,
                "frame": one.frame,
                "block": one.block,
                "slowness": output(k, one.signal).slowness,
                "allowed": allowed(source.streams[one.signal], references[one.signal])
                if one.learnable
                else None,
            }
            for k, one in enumerate(history.saved)
        ],
        "wrong": sum(not one.learnable for one in history.saved),
        "doubles": len(doubles(history.saved, output)),
        "probes": _probes(history, source, references),
    }


def _targets(
    history: History, source: ArenaSource, of_signal: Mapping[str, Sequence[int]]
) -> list[dict[str, Any]]:
    """For everything that could be learned: when it was, and after how many blocks of it."""
    found = []
    for stream, phases in enumerate(source.phases):
        for phase, signal in enumerate(phases):
            if not signal.learnable:
                continue
            begins = source.begins(phase)
            modules = [history.saved[k] for k in of_signal[signal.name]]
            frame = max(begins, modules[0].frame) if modules else None
            until = [t for t, _ in history.watched if frame is not None and t < frame]
            of_it = [t for t, s in history.watched[: len(until)] if s == stream and t >= begins]
            found.append(
                {
                    "stream": source.spec.streams[stream],
                    "signal": signal.name,
                    "frame": frame,
                    "block": len(until) if frame is not None else None,
                    "watched": len(of_it) if frame is not None else None,
                }
            )
    return found


def _probes(
    history: History, source: ArenaSource, references: Mapping[str, Reference]
) -> list[dict[str, Any]]:
    """What the modules of each signal tell of the world, against as many principal components."""
    found = []
    for name, reference in references.items():
        stream = source.streams[name]
        modules = [one.module for one in history.saved if one.signal == name]
        if not modules or not stream.state.shape[1]:
            continue
        own = np.concatenate([m.transform(stream.frames) for m in modules], axis=1)
        leading = reference.components.transform(stream.frames)
        n = min(own.shape[1], leading.shape[1])
        found.append(
            {
                "signal": name,
                "outputs": n,
                "modules": probe(own[:, :n], stream.state),
                "components": probe(leading[:, :n], stream.state),
            }
        )
    return found
