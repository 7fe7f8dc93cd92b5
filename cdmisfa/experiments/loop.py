"""The loop of every run: take a block, learn, call the sinks; and the sinks of every run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final

from cdmisfa.core.blocks import Block, FrameSource, turn_to
from cdmisfa.core.errors import LogExhaustedError
from cdmisfa.core.learning import Keyframe, Learner, Sink
from cdmisfa.core.signals import BlockSignals, SignalsHash

if TYPE_CHECKING:
    from replay.runs.writer import RunWriter

INTERRUPTED: Final = "interrupted"
EXHAUSTED: Final = "log_exhausted"

# Why a run ended, in words.
ENDINGS: Mapping[str, str] = {
    "max_modules": "as many modules as asked for were learned",
    "max_iterations": "the asked number of iterations is over",
    "nothing_left": "exploration ended long ago and no further abstraction converged",
    "all_decided": "every stream is learned, known or given up",
    EXHAUSTED: "there were no more frames",
    INTERRUPTED: "it was interrupted",
}

# Default iterations between two keyframes, a compromise of log size and time to resume.
EVERY = 100

# A keyframe waits until the log has grown by this many times the size of the one before.
SHARE = 5


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
        learner: continues from its current state.
        sinks: called with everything, one after the other; one that raises ends the run.
        stop: called before every block; true ends the run.
        max_iterations: end after this many.
        max_modules: end after this many modules; by default as the learner says.

    Returns:
        Why the run ended, a key of `ENDINGS`.

    Raises:
        LogExhaustedError: the source has not enough frames for a single block.
    """
    modules = learner.max_modules if max_modules is None else max_modules
    while True:
        ended = ending(learner, modules, max_iterations) or (INTERRUPTED if stop() else "")
        if ended:
            break
        try:
            block = source.take(learner.stream, learner.tau)
        except LogExhaustedError as error:
            if stop():  # it ended while it waited for frames to be recorded
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
    """Return the key of `ENDINGS` for which a learner must stop now, or "" to continue."""
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
    """Writes the learner's state into the log of its run, at intervals and at its end.

    It follows the log among the sinks, so that the log holds every iteration before.

    Args:
        log: the run's log.
        source: the source of the run.
        learner: the learner.
        versions: versions of the packages that compute it.
        every: iterations between two keyframes, 0 writes one at the end only; None for every
            `EVERY` iterations, if a keyframe is smaller than the log before it by `SHARE`.
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
        if not self._due:  # the size of the first one, compressed, is not known yet
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
