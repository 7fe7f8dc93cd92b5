"""What words of a command line name: recordings, runs, and logs of others, opened alike."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__, {"replay.inputs.opening": "open_log", "replay.inputs.words": "places"}
)
