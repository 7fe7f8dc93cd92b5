"""The loop of every run: take a block, learn, tell the sinks; and the sinks of every run."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.blocks import Block, FrameSource, turn_to
from cdmisfa.core.errors import LogExhaustedError, UsageError, one_line
from cdmisfa.core.learning import Keyframe, Learner, Sink
from cdmisfa.core.signals import BlockSignals, SignalsHash
from replay.stored import StoredSource

if TYPE_CHECKING:
    from replay.runs.writer import RunWriter

INTERRUPTED: Final = "interrupted"
"""Why a run ended that was stopped before it came to an end of its own."""

EXHAUSTED: Final = "log_exhausted"
"""Why a run ended of which the source had no further block, before it came to its own end."""

ENDINGS: Mapping[str, str] = {
    "max_modules": "as many modules as asked for were learned",
    "max_iterations": "the asked number of iterations is over",
    "nothing_left": "exploration ended long ago and no further abstraction converged",
    "all_decided": "every stream is learned, known or given up",
    EXHAUSTED: "there were no more frames",
    INTERRUPTED: "it was interrupted",
}
"""Why a run ended, in words."""

SAMPLED = 4
"""Frames of a block of which the variance between episodes is taken."""

FEWEST_EPISODES = 8
"""Episodes that tell of it."""

EVERY = 100
"""Iterations between two keyframes, where nothing else is said and the log has room for them."""

SHARE = 5
"""A keyframe waits until the log has grown by so many times the size of the one before."""


def learn_blocks(
    source: FrameSource,
    learner: Learner,
    sinks: Sequence[Sink] = (),
    *,
    stop: Callable[[], bool] = lambda: False,
    max_iterations: int | None = None,
    max_modules: int | None = None,
) -> str:
    """Let a learner learn from a source until nothing is left to learn.

    Args:
        source: live or recorded; left open.
        learner: learns on from where it is.
        sinks: told of everything, one after the other.
        stop: asked before every block; true ends the run.
        max_iterations: end after so many.
        max_modules: end after so many modules; by default as the learner says.

    Returns:
        Why it ended, a key of `ENDINGS`.

    Raises:
        LogExhaustedError: the source has not enough for a single block.
        UsageError: these are no source and no learner.
    """
    if not hasattr(source, "take") or not hasattr(learner, "step"):
        given = f"{type(source).__name__} and {type(learner).__name__}"
        raise UsageError(f"{given} given: learn_blocks takes a source that is open, then a learner")
    modules = learner.max_modules if max_modules is None else max_modules
    sinks = [BetweenEpisodes(source, sinks), *sinks]
    while True:
        ended = ending(learner, modules, max_iterations) or (INTERRUPTED if stop() else "")
        if ended:
            break
        try:
            block = source.take(learner.stream, learner.tau)
        except LogExhaustedError as error:
            if stop():  # while it waited for frames to be recorded
                continue
            if not learner.iteration:
                raise
            ended = EXHAUSTED
            for sink in sinks:
                sink.event(source.t, learner.iteration - 1, f"the source ended: {error}", "WARNING")
            break
        signals = learner.step(block)
        turn_to(source, block.stream, learner.stream)
        for sink in sinks:
            sink.block(block, signals, learner)
            for text in learner.events:
                sink.event(block.t, signals.iteration, text)
    for sink in sinks:
        sink.event(source.t, max(learner.iteration - 1, 0), f"ended: {ENDINGS[ended]}")
        sink.finish()
    return ended


def ending(learner: Learner, max_modules: int | None, max_iterations: int | None) -> str:
    """The key of `ENDINGS` for which a learner is to stop now, or "" where it is to learn on."""
    if max_modules is not None and len(learner.modules) >= max_modules:
        return "max_modules"
    if max_iterations is not None and learner.iteration >= max_iterations:
        return "max_iterations"
    return learner.over


class Digest(SignalsHash, Sink):
    """The hash of a run's signals; see `SignalsHash`."""

    def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
        """See `Sink`."""
        self.add(signals)


class Keyframes(Sink):
    """Writes the learner's state into the log of its run, every so many iterations and at its end.

    It comes after the log, which then holds every iteration before.

    Args:
        log: of the run.
        source: what it learns from.
        learner: what learns.
        versions: of the packages that compute it.
        every: iterations between two, 0 writes one at the end only; None for as often as
            `EVERY` iterations, where they stay below a part in `SHARE` of the log before them.
    """

    def __init__(
        self,
        log: RunWriter,
        source: FrameSource,
        learner: Learner,
        versions: Mapping[str, str],
        every: int | None = None,
    ) -> None:
        self._log, self._source, self._learner = log, source, learner
        self._versions = versions
        self._every = EVERY if every is None else every
        self._share = SHARE if every is None else 0
        self._due = 0
        self._t: int | None = None

    def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
        """See `Sink`."""
        self._t = self._source.t
        if not self._every or learner.iteration % self._every:
            return
        self._log.flush()
        before = self._log.size
        if before < self._due:
            return
        keyframe = self._keyframe()
        if not self._due:  # the first: its size, compressed, is not known yet
            self._due = self._share * sum(a.nbytes for a in keyframe.state.arrays.values())
            if before < self._due:
                return
        self._log.keyframe(keyframe)
        self._due = self._log.size + self._share * (self._log.size - before)

    def finish(self) -> None:
        """See `Sink`."""
        self._log.keyframe(self._keyframe())
        self._log.sync()

    def _keyframe(self) -> Keyframe:
        learner = self._learner
        # A camera's own t may lie behind the last block, where it ended within the next one.
        t = self._source.t if self._t is None else self._t
        return Keyframe(learner.iteration, t, learner.state, self._versions)


class BetweenEpisodes(Sink):
    """Tells of each stream of logs whether it differs more between episodes than within them.

    That is the intraclass correlation of a few frames of each block, of all pixels together.

    Args:
        source: what is learned from.
        others: all sinks of the run, which are told at its end.
    """

    def __init__(self, source: FrameSource, others: Sequence[Sink]) -> None:
        logs = source if isinstance(source, StoredSource) and source.gaps else None
        self._source = None if logs is None or logs.centre == "episode" else logs
        self._others = others
        self._streams: dict[int, _Spread] = {}
        self._at = 0, 0

    def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
        """See `Sink`."""
        if self._source is not None:
            self._at = block.t, signals.iteration
            spread = self._streams.setdefault(block.stream, _Spread())
            episode = self._source.episode(block.stream, block.t)
            spread.add(episode, block.frames[:: max(len(block) // SAMPLED, 1)])

    def finish(self) -> None:
        """See `Sink`."""
        for stream, spread in sorted(self._streams.items()):
            if self._source is not None and (share := spread.between()) > 0.5:
                name = self._source.spec.streams[stream]
                said = f"{name}: {share:.0%} of its variance is between episodes, not within"
                for other in self._others:
                    other.event(
                        *self._at, f"{said}; --set input.centre=episode leaves it out", "WARNING"
                    )


class _Spread:
    """How frames are spread within episodes and between them."""

    def __init__(self) -> None:
        self._episode: tuple[int, int] | None = None
        self._count = self._episodes = self._frames = 0
        self._sum: Any = 0.0
        self._total: Any = 0.0
        self._squares = self._of_means = 0.0

    def add(self, episode: tuple[int, int], frames: NDArray[Any]) -> None:
        """Take frames of an episode in."""
        if episode != self._episode:
            self._end()
            self._episode, self._count, self._sum = episode, 0, 0.0
        x = frames.reshape(len(frames), -1).astype(np.float64)
        self._count += len(x)
        self._sum = self._sum + x.sum(axis=0)
        self._squares += float((x * x).sum())

    def between(self) -> float:
        """The share of the variance that is between episodes; 0 where these are too few."""
        self._end()
        if self._episodes < FEWEST_EPISODES or self._frames <= self._episodes:
            return 0.0
        within = (self._squares - self._of_means) / (self._frames - self._episodes)
        means = self._of_means - float((self._total * self._total).sum()) / self._frames
        between = means / (self._episodes - 1) - within
        between = max(between, 0.0) * self._episodes / self._frames
        return between / (between + within) if between else 0.0

    def _end(self) -> None:
        if self._count:
            self._episodes += 1
            self._frames += self._count
            self._of_means += float((self._sum * self._sum).sum()) / self._count
            self._total = self._total + self._sum
            self._count = 0


class BestEffort(Sink):
    """A sink that learning does not depend on: where it fails, it is let go with a warning.

    Args:
        sink: told of everything until it raises; then not even that the run is over.
        others: all sinks of the run, which are told of it.
    """

    def __init__(self, sink: Sink, others: Sequence[Sink]) -> None:
        self._sink: Sink | None = sink
        self._others = others
        self._at = 0, 0

    def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
        """See `Sink`."""
        self._at = block.t, signals.iteration
        self._tell("block", block, signals, learner)

    def event(self, t: int, iteration: int, text: str, level: str = "INFO") -> None:
        """See `Sink`."""
        self._tell("event", t, iteration, text, level)

    def finish(self) -> None:
        """See `Sink`."""
        self._tell("finish")

    def _tell(self, method: str, *what: Any) -> None:
        if (sink := self._sink) is None:
            return
        try:
            getattr(sink, method)(*what)
        except Exception as error:  # whatever the caller's code raises
            self._sink = None
            said = f"the sink {type(sink).__name__} failed and is told no more: {one_line(error)}"
            warnings.warn(said, RuntimeWarning, stacklevel=2)
            for other in self._others:
                other.event(*self._at, said, "WARNING")
