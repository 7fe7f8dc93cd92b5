"""Other people's camera logs written as a recording of ours."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Final

from cdmisfa.core.errors import UsageError
from recorder.config import RecordConfig
from recorder.log.folder import held
from recorder.log.parts import ViewParts
from recorder.log.viewlog import Identity
from recorder.recording import (
    ViewRecording,
    make_folder,
    refuse_existing,
    remove_views,
    written,
)
from replay.camera_logs.names import view_names
from replay.camera_logs.source import ForeignSource

KIND: Final = "foreign"
"""What the recording states as its scene."""
REMEDY: Final = "go on with --resume or overwrite with --force"
_BLOCK: Final = 64


def convert(
    source: ForeignSource,
    folder: Path,
    *,
    settings: RecordConfig | None = None,
    force: bool = False,
    resume: bool = False,
    progress: Callable[[float], None] | None = None,
) -> list[ViewRecording]:
    """Write every stream of a source as a view of a recording.

    The files do not depend on having been interrupted and resumed.

    The recording has the source's frames at its times and rate; the logs they came from, with
    their checksums and how images became frames, stand in its config.json.

    Args:
        source: does not loop; left open.
        folder: made if it does not exist.
        settings: how the files are written.
        force: overwrite an earlier recording in the folder.
        resume: go on where an earlier attempt with the same source ended.
        progress: told after every block how many frames of all streams are written.

    Raises:
        UsageError: the folder exists, the source has no end, its images are too small, or what
            is to be gone on with came from another one.
        LogDamagedError: an image cannot be read.
        LogWriteError: the disk does not take it.
    """
    if source.spec.length is None:
        raise UsageError("a source that loops has no end: convert it without looping")
    if force and resume:
        raise UsageError("--force starts anew and --resume goes on: use one of them")
    if not resume:
        refuse_existing(folder, force=force, remedy=REMEDY)
    spec = replace(source.spec, streams=view_names(source.spec.streams))
    identity = Identity(KIND, 0, spec, {"source": dict(source.describe())})
    count = source.spec.length
    make_folder(folder)
    with ExitStack() as unfinished:
        unfinished.enter_context(held(folder))
        if force:
            remove_views(folder, spec.streams)
        upto = count if resume else None
        used = settings or RecordConfig()
        logs = [ViewParts(folder, view, identity, used, resume=upto) for view in spec.streams]
        for log in logs:
            unfinished.callback(log.abandon)
            log.open()
        for log in logs:
            source.seek(log.t)
            while log.t < count:
                log.write(source.take(log.stream, min(_BLOCK, count - log.t)))
                if progress is not None:
                    progress(sum(each.t for each in logs) / len(logs))
        for log in logs:
            log.finish()
    return [written(log.view, path, n) for log in logs for path, n in log.parts]
