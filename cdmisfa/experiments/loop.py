"""The loop that every run is: watch, learn, tell. And why it ends."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

from cdmisfa.core.blocks import Block, FrameSource
from cdmisfa.core.errors import LogExhaustedError
from cdmisfa.core.learning import Learner, Sink
from cdmisfa.core.signals import BlockSignals, SignalsHash

INTERRUPTED: Final = "interrupted"
"""Why a run ended that was stopped before it came to an end of its own."""

ENDINGS: Mapping[str, str] = {
    "max_modules": "as many modules as asked for were learned",
    "max_iterations": "the asked number of iterations is over",
    "nothing_left": "exploration ended long ago and no further abstraction converged",
    "all_decided": "every stream is learned, known or given up",
    "log_exhausted": "the recording ended",
    INTERRUPTED: "it was interrupted",
}
"""Why a run ended, in words."""


def learn(
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
        LogExhaustedError: a recording ended first; the sinks are finished.
    """
    exhausted: LogExhaustedError | None = None
    modules = learner.max_modules if max_modules is None else max_modules
    while True:
        ended = ending(learner, modules, max_iterations) or (INTERRUPTED if stop() else "")
        if ended:
            break
        try:
            block = source.take(learner.stream, learner.tau)
        except LogExhaustedError as error:
            if stop():  # while it waited for frames to be recorded
                continue
            ended, exhausted = "log_exhausted", error
            break
        signals = learner.step(block)
        for sink in sinks:
            sink.block(block, signals, learner)
            for text in learner.events:
                sink.event(block.t, signals.iteration, text)
    for sink in sinks:
        sink.event(source.t, max(learner.iteration - 1, 0), f"ended: {ENDINGS[ended]}")
        sink.finish()
    if exhausted is not None:
        raise exhausted
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
