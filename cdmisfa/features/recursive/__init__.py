"""Recursive slow feature analysis: exact on all frames so far, without a learning rate."""

from cdmisfa.core.faces import face

__getattr__, __dir__, __all__ = face(
    __name__, {"cdmisfa.features.recursive.recursive": "RecursiveSFA"}
)
