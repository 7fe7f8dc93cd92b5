"""Where to look, and when to save what was learned."""

from cdmisfa.core.faces import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "cdmisfa.agents.learner": "CuriousLearner",
    },
)
