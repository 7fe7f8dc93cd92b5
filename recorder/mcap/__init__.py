"""MCAP files: their bytes, appended to whatever takes them."""

from cdmisfa.core.faces import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "recorder.mcap.checksum": "crc32",
        "recorder.mcap.writer": "McapWriter",
    },
)
