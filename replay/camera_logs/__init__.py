"""Other people's logs of cameras as sources of frames."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "replay.camera_logs.source": "ForeignSource",
        "replay.camera_logs.opening": "open_images",
        "replay.camera_logs.stream": "ImageStream",
    },
)
