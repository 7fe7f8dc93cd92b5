"""Recordings on disk: one MCAP file a view, written whole or not at all."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "recorder.log.logfile": "LogFile",
        "recorder.log.begun": "Begun",
        "recorder.log.split": "Split",
        "recorder.log.viewfacts": "Identity ViewFacts",
        "recorder.log.viewlog": "ViewLog ViewParts",
    },
)
