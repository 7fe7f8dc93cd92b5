"""Other people's camera logs written as a recording of ours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cdmisfa.core.errors import UsageError
from recorder.config import view_names
from recorder.recording import ViewRecording, record
from replay.camera_logs.source import ForeignSource


def convert(source: ForeignSource, folder: Path, **options: Any) -> list[ViewRecording]:
    """Write every stream of a source as a view of a recording.

    The recording has the source's frames at its times and rate; the logs they came from, with
    their checksums and how images became frames, stand in its config.json.

    Args:
        source: does not loop; left open.
        folder: made if it does not exist.
        options: those of `record`.

    Raises:
        UsageError: the source loops, its images are too small, or as for `record`.
        LogDamagedError: an image cannot be read.
        LogWriteError: the disk does not take it.
    """
    if source.spec.length is None:
        raise UsageError("a source that loops has no end: convert it without looping")
    return record(source, folder, names=view_names(source.spec.streams), **options)
