"""Other people's camera logs written as a recording of ours."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Final

from cdmisfa.blocks import SourceSpec
from cdmisfa.errors import UsageError
from recorder.config import RecordConfig
from recorder.folder import held
from recorder.recording import (
    ViewRecording,
    make_folder,
    refuse_existing,
    remove_views,
    written,
)
from recorder.viewlog import Identity, ViewLog
from replay.foreign import ForeignSource

KIND: Final = "foreign"
"""What the recording states as its scene."""
_BLOCK: Final = 64


def convert(
    source: ForeignSource,
    folder: Path,
    *,
    settings: RecordConfig | None = None,
    force: bool = False,
    progress: Callable[[float], None] | None = None,
) -> list[ViewRecording]:
    """Write every stream of a source as a view of a recording.

    The recording has the source's frames at its times and rate; the logs they came from, with
    their checksums and how images became frames, stand in its config.json.

    Args:
        source: does not loop; left open.
        folder: made if it does not exist.
        settings: how the files are written.
        force: overwrite an earlier recording in the folder.
        progress: told after every block how many frames of all streams are written.

    Raises:
        UsageError: the folder exists, or the source has no end.
        LogDamagedError: an image cannot be read.
        LogWriteError: the disk does not take it.
    """
    if source.spec.length is None:
        raise UsageError("a source that loops has no end: convert it without looping")
    refuse_existing(folder, force=force)
    spec = replace(source.spec, streams=view_names(source.spec.streams))
    identity = Identity(KIND, 0, spec, {"source": dict(source.describe())})
    make_folder(folder)
    logs: list[ViewLog] = []
    done = 0
    with ExitStack() as unfinished:
        unfinished.enter_context(held(folder))
        if force:
            remove_views(folder, spec.streams)
        for view in spec.streams:
            logs.append(ViewLog(folder, view, identity, settings or RecordConfig()))
            unfinished.callback(logs[-1].abandon)
        for log in logs:
            source.seek(0)
            for n in _cuts(spec):
                log.write(source.take(log.stream, n))
                done += n
                if progress is not None:
                    progress(done / len(logs))
        for log in logs:
            log.finish()
    return [written(log.view, log.path, log.t) for log in logs]


def view_names(topics: Sequence[str]) -> tuple[str, ...]:
    """Topics as names of views, which are names of files, too: "/cam/left" is cam_left."""
    names: list[str] = []
    for topic in topics:
        plain = re.sub(r"[^A-Za-z0-9_.-]+", "_", topic).strip("._") or "stream"
        taken = sum(name == plain or name.startswith(f"{plain}-") for name in names)
        names.append(f"{plain}-{taken + 1}" if taken else plain)
    return tuple(names)


def _cuts(spec: SourceSpec) -> list[int]:
    """Lengths of the blocks that make up the source."""
    whole, rest = divmod(spec.length or 0, _BLOCK)
    return [_BLOCK] * whole + [rest] * (rest > 0)
