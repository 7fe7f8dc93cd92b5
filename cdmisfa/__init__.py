"""Curiosity-driven modular incremental slow feature analysis (CD-MISFA 2.0)."""

from typing import TYPE_CHECKING

from cdmisfa.core.faces import face

if TYPE_CHECKING:
    from cdmisfa.agents.learner import CuriousLearner as CuriousLearner
    from cdmisfa.core.blocks import Block as Block
    from cdmisfa.core.blocks import FrameSource as FrameSource
    from cdmisfa.core.blocks import SourceSpec as SourceSpec
    from cdmisfa.core.config import LearnerConfig as LearnerConfig
    from cdmisfa.core.errors import CdmisfaError as CdmisfaError
    from cdmisfa.core.modules import Module as Module
    from cdmisfa.core.signals import SIGNALS as SIGNALS
    from cdmisfa.core.signals import BlockSignals as BlockSignals
    from recorder.world.oscillatory import OscillatorySource as OscillatorySource
    from replay.runs.run import Run as Run

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "cdmisfa.agents.learner": "CuriousLearner",
        "cdmisfa.core.blocks": "Block FrameSource SourceSpec",
        "cdmisfa.core.config": "LearnerConfig",
        "cdmisfa.core.errors": "CdmisfaError",
        "cdmisfa.core.modules": "Module",
        "cdmisfa.core.signals": "SIGNALS BlockSignals",
        "recorder.world.oscillatory": "OscillatorySource",
        "replay.runs.run": "Run",
    },
)
