"""Our recordings as sources of frames."""

from cdmisfa.core.faces import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "replay.recordings.source": "RecordedSource",
        "replay.recordings.followed": "FollowedSource",
        "replay.recordings.view_file": "NoRecordingError ViewFile",
    },
)
