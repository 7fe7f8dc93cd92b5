"""Runs and recordings for other programs: tables, figures, videos, datasets."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "replay.export.forms": "FORMS Form export",
        "replay.export.tables": "export_signals",
        "replay.export.figures": "draw_figures",
        "replay.export.history": "read_history",
    },
)
