"""The MCAP file: read with no trust in what it says, and written."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "recorder.mcap.reader": "LogReader",
        "recorder.mcap.writer": "McapWriter",
    },
)
