"""What the viewer lays out of a run: for each kind of learner its own story, in tabs."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "replay.view.layouts.of_run": "run_layout",
    },
)
