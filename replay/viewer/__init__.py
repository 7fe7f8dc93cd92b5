"""The program that shows a view: its window, its page, its pictures."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "replay.viewer.window": "open_window serve",
        "replay.viewer.headless": "screenshot",
        "replay.viewer.live": "LiveView",
        "replay.viewer.catalogue": "serve_catalogue",
    },
)
