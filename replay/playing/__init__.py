"""A recording played in real time, to a viewer or as if it were a running robot."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {"replay.playing.as_robot": "play_as_robot", "replay.playing.in_rerun": "play_in_rerun"},
)
