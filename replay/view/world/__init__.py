"""The world that a run was in, as the first tab of its view shows it."""

from cdmisfa.core.faces import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "replay.view.world.first": "WorldView",
    },
)
