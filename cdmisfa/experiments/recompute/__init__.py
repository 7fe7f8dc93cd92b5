"""Any moment of a run again: its learner's state, another future from there, and the proof."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "cdmisfa.experiments.recompute.again": "Again",
        "cdmisfa.experiments.recompute.check": "Checked check_run",
        "cdmisfa.experiments.recompute.forks": "fork_run",
        "cdmisfa.experiments.recompute.run": "Run",
    },
)
