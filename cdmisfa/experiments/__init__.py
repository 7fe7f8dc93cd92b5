"""One run, or many: sources, learners and logs put together."""

from cdmisfa.core.faces import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "cdmisfa.experiments.run": "RunResult learn",
        "cdmisfa.experiments.sources": "open_source",
        "cdmisfa.experiments.sweep": "SweepReport Trial",
        "cdmisfa.experiments.trial": "run_trial",
    },
)
