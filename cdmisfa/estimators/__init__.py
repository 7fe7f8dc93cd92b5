"""Slow feature analysis in the interfaces of scikit-learn and of river."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "cdmisfa.estimators.batches": "IncSFA RecursiveSFA",
        "cdmisfa.estimators.samples": "OnlineSFA",
    },
)
