"""Our recordings as sources of frames."""

from cdmisfa.core.faces import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "replay.recordings.source": "RecordedSource",
        "replay.recordings.followed": "FollowedSource",
        "replay.recordings.poses": "head_poses yaw_of",
        "replay.recordings.view_file": "NoRecordingError ViewFile",
    },
)
