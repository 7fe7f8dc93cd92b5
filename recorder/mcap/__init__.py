"""The MCAP file: read with no trust in what it says, and written."""

from cdmisfa.core.faces import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "recorder.mcap.reader": "LogReader",
        "recorder.mcap.writer": "McapWriter",
    },
)
