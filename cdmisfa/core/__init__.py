"""For all: blocks, signals, modules, configuration, errors, registries, processes."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "cdmisfa.core.blocks": "Block FrameSource HeadPose SeekableSource SourceSpec",
        "cdmisfa.core.config": "LearnerConfig",
        "cdmisfa.core.errors": "CdmisfaError LogDamagedError LogExhaustedError UsageError",
        "cdmisfa.core.learning": "Learner LearnerState Sink",
        "cdmisfa.core.modules": "Module",
        "cdmisfa.core.registry": "Registry",
        "cdmisfa.core.signals": "SIGNALS BlockSignals",
    },
)
