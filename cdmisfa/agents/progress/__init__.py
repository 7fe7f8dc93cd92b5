"""Learn from any camera: one candidate a stream, and attention by the progress of learning."""

from cdmisfa.core.faces import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "cdmisfa.agents.progress.config": "ProgressConfig",
        "cdmisfa.agents.progress.learner": "ProgressLearner",
    },
)
