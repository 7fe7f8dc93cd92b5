"""Live streams from outside: cameras, robots, simulated tasks, and arrays of the caller's."""

from cdmisfa.core.faces import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "recorder.cameras.camera": "Camera",
        "recorder.cameras.gym": "GymSource",
        "recorder.cameras.live": "LiveSource",
        "recorder.cameras.stepped": "ArraySource",
        "recorder.cameras.words": "CAMERAS CameraKind open_live",
    },
)
