"""The MCAP file, trusting nothing in it."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "replay.mcap.reader": "LogReader",
    },
)
