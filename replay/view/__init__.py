"""What Rerun shows of runs and recordings."""

from cdmisfa.core.faces import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "replay.view.build": "build_view",
        "replay.view.overlay": "build_overlay",
    },
)
