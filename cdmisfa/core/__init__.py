"""The words everybody shares: blocks, signals, modules, configuration, errors."""

from cdmisfa.core.faces import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "cdmisfa.core.blocks": "Block FrameSource SourceSpec",
        "cdmisfa.core.signals": "SIGNALS BlockSignals",
        "cdmisfa.core.modules": "Module",
        "cdmisfa.core.config": "LearnerConfig",
        "cdmisfa.core.errors": "CdmisfaError LogDamagedError UsageError",
    },
)
