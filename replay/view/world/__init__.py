"""The world that a run was in, as the first tab of its view shows it."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "replay.view.world.first": "WorldView",
    },
)
