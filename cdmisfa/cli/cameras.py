"""Live streams to learn from, recorded meanwhile where that is asked for."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from cdmisfa.cli.printing import say_counts, tell

if TYPE_CHECKING:
    from cdmisfa.core.blocks import FrameSource
    from cdmisfa.experiments.sources import Configuration
    from recorder.cameras.options import LiveOptions
    from replay.camera_logs.options import CameraOptions


@contextlib.contextmanager
def live_source(
    words: Sequence[str],
    live: LiveOptions,
    cameras: CameraOptions,
    out: Path | None,
    record_to: Path | None,
    *,
    preset: str | None,
    settings: Sequence[str],
    fsync_every: float | None,
    force: bool,
) -> Iterator[tuple[FrameSource, Configuration]]:
    """Live streams to learn from, recorded meanwhile where that is asked for.

    Args:
        words: a stream each.
        live: what `live_options` say, and a seed.
        cameras: what `camera_options` say.
        out: folder of the run; looked at before the cameras are opened.
        record_to: folder of the recording.
        preset: as the option.
        settings: as the option --set.
        fsync_every: as the option.
        force: as the option.
    """
    from cdmisfa.experiments.sources import open_cameras_now
    from recorder.live import RecordedWhileWatched
    from recorder.log.files import refuse_existing

    for folder in (out, record_to):
        if folder is not None:
            refuse_existing(folder, force=force, goes_on=False)
    source, configuration = open_cameras_now(
        words, live, cameras=cameras, preset=preset, settings=settings, say=tell
    )
    with contextlib.closing(source):
        try:
            if record_to is None:
                yield source, configuration
                return
            recorded = RecordedWhileWatched(
                source,
                record_to,
                settings=configuration.record,
                fsync_every=fsync_every,
                force=force,
            )
            with recorded:
                yield recorded, configuration
            tell(f"recording {record_to}")
        finally:
            say_counts(source)
