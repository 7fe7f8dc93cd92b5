"""The paper's own experiments, and the demonstration."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "cdmisfa.paper.demo": "Report",
        "cdmisfa.paper.reproduce": "Claim Experiment Findings Line Request Trial",
    },
)
