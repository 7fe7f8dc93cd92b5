"""Frames in, slow outputs out."""

from cdmisfa.core.faces import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "cdmisfa.features.incsfa": "IncSFA",
        "cdmisfa.features.sfa": "batch_sfa",
    },
)
