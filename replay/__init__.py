"""Reading logs, and showing what happened."""

from cdmisfa.core.faces import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "replay.recordings.source": "RecordedSource",
        "replay.runs.run": "Run",
    },
)
