"""Recordings on disk: one MCAP file a view, written whole or not at all."""

from cdmisfa.core.faces import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "recorder.log.logfile": "LogFile",
        "recorder.log.begun": "Begun",
        "recorder.log.split": "Split",
        "recorder.log.viewfacts": "Identity ViewFacts",
        "recorder.log.viewlog": "ViewLog ViewParts",
    },
)
