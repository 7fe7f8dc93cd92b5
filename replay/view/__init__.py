"""What Rerun shows of runs and recordings."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "replay.view.build": "build_view",
        "replay.view.overlay": "build_overlay",
    },
)
