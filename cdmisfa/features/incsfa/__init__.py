"""Incremental slow feature analysis."""

from cdmisfa.core.faces import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "cdmisfa.features.incsfa.abstraction": "IncSFA",
        "cdmisfa.features.incsfa.state": "Params State new_state parameters",
    },
)
