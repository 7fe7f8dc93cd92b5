"""Our recordings as sources of frames."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "replay.recordings.source": "RecordedSource",
        "replay.recordings.followed": "FollowedSource",
        "replay.recordings.poses": "head_poses yaw_of",
        "replay.recordings.view_file": "NoRecordingError ViewFile",
    },
)
