"""Runs and recordings for other programs: tables, images, videos, datasets."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "replay.export.forms": "FORMS Form export",
        "replay.export.tables": "export_signals",
    },
)
