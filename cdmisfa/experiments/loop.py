"""The loop of every run (take a block, learn, call the sinks), and two sinks of every run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

from cdmisfa.core.blocks import Block, FrameSource, turn_to
from cdmisfa.core.errors import LogExhaustedError
from cdmisfa.core.learning import Keyframe, Learner, Sink
from cdmisfa.core.outcomes import END_REASONS, EXHAUSTED, INTERRUPTED
from cdmisfa.core.signals import BlockSignals, SignalsHash

if TYPE_CHECKING:
    from replay.runs.writer import RunWriter

# Default number of iterations between two keyframes. Fewer make resuming faster and logs larger.
KEYFRAME_INTERVAL = 100

# A keyframe is delayed until the log has grown by this many times the size of the previous one, so
# that keyframes take at most a sixth of a log.
KEYFRAME_SPACING = 5


def learn_blocks(
    source: FrameSource,
    learner: Learner,
    sinks: Sequence[Sink] = (),
    *,
    stop: Callable[[], bool] = lambda: False,
    max_iterations: int | None = None,
    max_modules: int | None = None,
) -> str:
    """Let a learner learn from a source until it ends.

    Args:
        source: a live or recorded source; it stays open.
        learner: the learner, which continues from its current state.
        sinks: receive every iteration and event, in this order; an exception of one ends the run.
        stop: called before every block; True ends the run.
        max_iterations: largest number of iterations.
        max_modules: largest number of modules; None: the learner's default.

    Returns:
        The reason for the end, a key of `END_REASONS`.

    Raises:
        LogExhaustedError: the source is shorter than one block.
    """
    modules = learner.max_modules if max_modules is None else max_modules
    while True:
        ended = ending(learner, modules, max_iterations) or (INTERRUPTED if stop() else "")
        if ended:
            break
        try:
            block = source.take(learner.stream, learner.tau)
        except LogExhaustedError as error:
            if stop():  # the source ended because `stop` interrupted its wait for new frames
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
        sink.event(source.t, max(learner.iteration - 1, 0), f"ended: {END_REASONS[ended]}")
        sink.finish()
    return ended


def ending(learner: Learner, max_modules: int | None, max_iterations: int | None) -> str:
    """Return the key of `END_REASONS` for which a learner must stop now, or "" to continue."""
    if max_modules is not None and len(learner.modules) >= max_modules:
        return "max_modules"
    if max_iterations is not None and learner.iteration >= max_iterations:
        return "max_iterations"
    return learner.over


class Digest(SignalsHash, Sink):
    """Sink that computes the hash of a run's signals; see `SignalsHash`."""

    def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
        """See `Sink`."""
        self.add(signals)


class Keyframes(Sink):
    """Sink that writes the learner's state into the log, at intervals and at the end.

    It must follow the log among the sinks, so that the log already has the iterations before.

    Args:
        log: the log of the run.
        source: the source of the run.
        learner: the learner.
        versions: versions of the packages that compute the run.
        interval: iterations between two keyframes; 0: one at the end only; None:
            `KEYFRAME_INTERVAL`, but no more often than `KEYFRAME_SPACING` allows.
    """

    def __init__(
        self,
        log: RunWriter,
        source: FrameSource,
        learner: Learner,
        versions: Mapping[str, str],
        interval: int | None = None,
    ) -> None:
        self._log, self._source, self._learner = log, source, learner
        self._versions = versions
        self._interval = KEYFRAME_INTERVAL if interval is None else interval
        self._spacing = KEYFRAME_SPACING if interval is None else 0
        self._due = 0
        self._t: int | None = None

    def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
        """See `Sink`."""
        self._t = self._source.t
        if not self._interval or learner.iteration % self._interval:
            return
        self._log.flush()
        before = self._log.size
        if before < self._due:
            return
        keyframe = self._keyframe()
        if not self._due:  # the compressed size of the first keyframe is not known before
            self._due = self._spacing * sum(a.nbytes for a in keyframe.state.arrays.values())
            if before < self._due:
                return
        self._log.keyframe(keyframe)
        self._due = self._log.size + self._spacing * (self._log.size - before)

    def finish(self) -> None:
        """See `Sink`."""
        self._log.keyframe(self._keyframe())
        self._log.sync()

    def _keyframe(self) -> Keyframe:
        learner = self._learner
        # The t of a live source can be behind the last block, if the source ended within the next.
        t = self._source.t if self._t is None else self._t
        return Keyframe(learner.iteration, t, learner.state, self._versions)
