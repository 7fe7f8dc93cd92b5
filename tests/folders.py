"""What the folder of a recording or a run holds."""

from __future__ import annotations

from pathlib import Path

from replay.recordings.source import RecordedSource


def contents(folder: Path) -> dict[str, bytes]:
    """The bytes of all files of a folder, by their paths in it."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def coverage(recording: Path) -> dict[str, list[tuple[int, int]]]:
    """The stretches of frames that each view has."""
    with RecordedSource(recording) as source:
        return source.coverage()
