"""Curiosity-driven modular incremental slow feature analysis (CD-MISFA 2.0).

The names below load on first use, so that the command line starts without compiling.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cdmisfa.blocks import Block, FrameSource, SourceSpec
    from cdmisfa.config import LearnerConfig
    from cdmisfa.errors import CdmisfaError
    from cdmisfa.learner import CuriousLearner
    from cdmisfa.modules import Module
    from cdmisfa.signals import SIGNALS, BlockSignals
    from cdmisfa.streams import OscillatorySource

__all__ = [
    "SIGNALS",
    "Block",
    "BlockSignals",
    "CdmisfaError",
    "CuriousLearner",
    "FrameSource",
    "LearnerConfig",
    "Module",
    "OscillatorySource",
    "SourceSpec",
]

_HOMES = {
    "Block": "blocks",
    "FrameSource": "blocks",
    "SourceSpec": "blocks",
    "LearnerConfig": "config",
    "CdmisfaError": "errors",
    "CuriousLearner": "learner",
    "Module": "modules",
    "SIGNALS": "signals",
    "BlockSignals": "signals",
    "OscillatorySource": "streams",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'cdmisfa' has no attribute {name!r}")
    return getattr(import_module(f"cdmisfa.{_HOMES[name]}"), name)
