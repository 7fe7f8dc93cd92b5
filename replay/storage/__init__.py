"""Where bytes lie: a path or URL, and reading from it."""

from cdmisfa.core.faces import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "replay.storage.limits": "Limits limited",
        "replay.storage.listing": "log_files",
        "replay.storage.location": "Location Url",
        "replay.storage.opening": "open_store",
        "recorder.mcap.store": "Store",
    },
)
