"""Where bytes lie: a path or URL, and reading from it."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "replay.storage.limits": "Limits limited",
        "replay.storage.listing": "log_files",
        "replay.storage.location": "Location Url",
        "replay.storage.opening": "open_store",
        "recorder.mcap.store": "Store",
    },
)
