"""Where to look, and when to save what was learned."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "cdmisfa.agents.learner": "CuriousLearner",
    },
)
