"""The MCAP file, trusting nothing in it."""

from cdmisfa.core.faces import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "replay.mcap.reader": "LogReader",
    },
)
