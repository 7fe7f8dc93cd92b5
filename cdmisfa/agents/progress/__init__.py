"""Learn from any camera: one candidate a stream, and attention by the progress of learning."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "cdmisfa.agents.progress.config": "ProgressConfig",
        "cdmisfa.agents.progress.learner": "ProgressLearner",
    },
)
