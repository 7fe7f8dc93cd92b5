"""Slow feature analysis in the interfaces of scikit-learn and of river."""

from importlib import import_module
from typing import Any

_MODULES = {"IncSFA": "batches", "RecursiveSFA": "batches", "OnlineSFA": "samples"}


def __getattr__(name: str) -> Any:
    """Import an estimator on first use: scikit-learn and river each take a second to import."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
