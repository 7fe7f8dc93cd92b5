"""`Run`: a run on disk, and its learner at any moment of it."""

from __future__ import annotations

from collections.abc import Sequence

import replay.runs.run
from cdmisfa.core.learning import Learner
from cdmisfa.experiments.recompute.check import learner_after


class Run(replay.runs.run.Run):
    """What a run left behind, read where it is needed and only then.

    Args:
        path: the run's folder, or its log.

    Raises:
        UsageError: there is no such run, or it is of a later version of this software.
        LogDamagedError: its log cannot be read, here or in any later access.
    """

    def at(self, iterations: int, source: Sequence[str] = ()) -> Learner:
        """Its learner as it was after so many iterations, bit for bit.

        Args:
            iterations: done before; 0 is the beginning.
            source: words that name what it learned from, where it is not what the run says.

        Raises:
            UsageError: it has not so many, or its source is not there; what stands in its log, a
                keyframe every some hundred iterations, needs none.
            NotReproducedError: learning again gives other signals than its log holds.
        """
        return learner_after(self.log, iterations, source)[0]
