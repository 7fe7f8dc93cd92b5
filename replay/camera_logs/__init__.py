"""Other people's logs of cameras as sources of frames."""

from cdmisfa.core.faces import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "replay.camera_logs.source": "ForeignSource",
        "replay.camera_logs.opening": "open_images",
        "replay.camera_logs.stream": "ImageStream",
    },
)
