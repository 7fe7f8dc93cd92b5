"""MCAP files: their bytes, appended to whatever takes them."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "recorder.mcap.checksum": "crc32",
        "recorder.mcap.writer": "McapWriter",
    },
)
