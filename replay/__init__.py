"""Reading logs, and showing what happened."""

from typing import TYPE_CHECKING

from cdmisfa.core.exports import exports

if TYPE_CHECKING:
    from replay.recordings.source import RecordedSource as RecordedSource
    from replay.runs.run import Run as Run

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "replay.recordings.source": "RecordedSource",
        "replay.runs.run": "Run",
    },
)
