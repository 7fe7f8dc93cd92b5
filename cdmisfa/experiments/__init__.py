"""One run, or many: sources, learners and logs put together."""

from cdmisfa.core.faces import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "cdmisfa.experiments.loop": "Digest learn",
        "cdmisfa.experiments.runs": "RunResult run",
        "cdmisfa.experiments.sources": "open_source",
        "cdmisfa.experiments.sweep": "SweepReport Trial",
        "cdmisfa.experiments.trial": "run_trial",
    },
)
