"""Live streams from outside: cameras, robots, simulated tasks, and arrays of the caller's."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "recorder.cameras.live": "LiveSource",
        "recorder.cameras.readers": "Camera",
        "recorder.cameras.stepped": "ArraySource GymSource",
        "recorder.cameras.words": "CAMERAS CameraKind open_live",
    },
)
