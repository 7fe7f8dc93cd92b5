"""The paper's own experiments, and the demonstration."""

from cdmisfa.core.faces import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "cdmisfa.paper.demo": "Report",
        "cdmisfa.paper.reproduce": "Claim Experiment Findings Line Request Trial",
    },
)
