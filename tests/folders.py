"""What the folder of a recording or a run holds, and a bit of a file that is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from recorder.images.options import InputOptions
from replay.logs.source import LoggedSource
from replay.open_sources import open_external, open_recording


def contents(folder: Path) -> dict[str, bytes]:
    """The bytes of all files of a folder, by their paths in it."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def coverage(recording: Path) -> dict[str, list[tuple[int, int]]]:
    """The stretches of frames that each view has."""
    with open_recording(recording) as source:
        return source.coverage()


def flip(path: Path, at: int | None = None) -> None:
    """Change a bit of a file: of a byte of it, by default that in its middle."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2 if at is None else at] ^= 1
    path.write_bytes(data)


def external(
    paths: str | Path | Sequence[str | Path],
    topics: Sequence[str] = (),
    *,
    loop: bool = False,
    skip_damaged: bool = False,
    **chosen: Any,
) -> LoggedSource:
    """External logs, opened with some options."""
    options = InputOptions(topics=tuple(topics), **chosen)
    return open_external(paths, options, loop=loop, skip_damaged=skip_damaged)
