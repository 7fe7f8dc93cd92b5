"""What is in a log, whether it is whole, and saving what can be saved."""

from cdmisfa.core.faces import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "replay.integrity.info": "describe",
    },
)
