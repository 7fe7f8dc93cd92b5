"""Frames in, slow outputs out."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "cdmisfa.features.incsfa": "Feature IncrementalFeature",
        "cdmisfa.features.outputs": "project",
        "cdmisfa.features.recursive": "RecursiveFeature",
        "cdmisfa.features.sfa": "batch_sfa",
    },
)
