"""Outcomes of streams and runs, in the words that commands, reports and views share."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from cdmisfa.core.names import counted
from cdmisfa.core.signals import STATE_WORDS, STATES

# Reasons why the progress learner rejects a stream.
REJECTIONS = (CONSTANT, NOTHING_SLOW, NO_PROGRESS) = (
    "constant input",
    "no slow feature",
    "no progress",
)

# Note on a learned stream whose slow feature hardly varied within a test window.
TOO_SLOW: Final = (
    "slower than the tests can measure, so it may not hold on other frames; raise "
    "learner.test_frames and learner.window by the same factor"
)

# Keys of `END_REASONS`: the source had no more frames, and a signal asked the run to stop.
EXHAUSTED: Final = "log_exhausted"
INTERRUPTED: Final = "interrupted"

# Descriptions of the reasons for which a run ends.
END_REASONS: Mapping[str, str] = {
    "max_modules": "the limit on modules was reached (by default as many as streams)",
    "max_iterations": "the requested number of iterations was done",
    "nothing_left": "no module was saved for a long time after exploration ended",
    "all_decided": "each stream is learned, explained or rejected",
    EXHAUSTED: "the source has no more frames",
    INTERRUPTED: "it was interrupted",
}


def outcome_text(
    state: str, module: int | None, blocks: int, slowness: float | None, reason: str = ""
) -> str:
    """Return the outcome of a stream.

    Args:
        state: one of `STATES`.
        module: number of the module that gives the stream's slow feature, from 1.
        blocks: number of blocks of the stream until the decision.
        slowness: slowness of the feature on each block before the block is learned from.
        reason: one of `REJECTIONS`, or a note.

    Example:
        >>> outcome_text("given_up", None, 27, 0.2241, NOTHING_SLOW)
        'rejected after 27 blocks: no slow feature (slowness 0.2241 on new frames)'
    """
    text = STATE_WORDS[STATES.index(state)]
    text += f" by module {module}" if module and state != STATES[0] else ""
    text += f" after {counted(blocks, 'block')}" + (f": {reason}" if reason else "")
    if slowness is not None and math.isfinite(slowness):
        text += f" (slowness {slowness:.4f} on new frames)"
    return text
