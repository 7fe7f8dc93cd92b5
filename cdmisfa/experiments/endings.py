"""Why a run or a trial ends."""

from __future__ import annotations

from collections.abc import Mapping

from cdmisfa.core.learning import Learner

ENDINGS: Mapping[str, str] = {
    "max_modules": "as many modules as asked for were learned",
    "max_iterations": "the asked number of iterations is over",
    "nothing_left": "exploration ended long ago and no further abstraction converged",
    "log_exhausted": "the recording ended",
    "interrupted": "it was interrupted",
}
"""Why a run ended, in words."""


def ending(learner: Learner, max_modules: int, max_iterations: int | None) -> str:
    """The key of `ENDINGS` for which a learner is to stop now, or "" where it is to learn on.

    Args:
        learner: between two iterations.
        max_modules: end after so many modules.
        max_iterations: end after so many iterations; None never.
    """
    if len(learner.modules) >= max_modules:
        return "max_modules"
    if max_iterations is not None and learner.iteration >= max_iterations:
        return "max_iterations"
    return "nothing_left" if learner.over else ""
