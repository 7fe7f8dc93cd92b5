"""Frames in, slow outputs out."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "cdmisfa.features.incsfa": "Feature IncSFA",
        "cdmisfa.features.outputs": "project",
        "cdmisfa.features.recursive": "RecursiveSFA",
        "cdmisfa.features.sfa": "batch_sfa",
    },
)
