"""The program that shows a view: its window, its page, its pictures."""

from cdmisfa.core.faces import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "replay.viewer.window": "open_window serve",
        "replay.viewer.headless": "screenshot",
        "replay.viewer.live": "LiveView",
        "replay.viewer.catalogue": "serve_catalogue",
    },
)
