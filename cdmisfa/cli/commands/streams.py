"""Record live streams, and print what was recorded."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cdmisfa.cli.interrupts import stoppable
from cdmisfa.cli.printing import print_document, print_table, say_counts, tell
from cdmisfa.cli.progress import bar
from cdmisfa.core.errors import UsageError

if TYPE_CHECKING:
    from recorder.images.options import InputOptions
    from recorder.recording import ViewRecording


def record_streams(
    ctx: click.Context,
    words: Sequence[str],
    out: Path,
    inputs: InputOptions,
    *,
    as_json: bool,
    force: bool,
    frames: int | None = None,
    split: str | None = None,
    **how: Any,
) -> None:
    """Record live streams until there are so many frames, they end, or Ctrl-C."""
    from cdmisfa.experiments.sources import open_cameras_now
    from recorder.config import Split
    from recorder.live import RecordedWhileWatched, record_watched
    from recorder.log.files import refuse_existing
    from recorder.recording import DEFAULT_FRAMES

    refuse_existing(out, force=force, goes_on=False)
    source, configuration = open_cameras_now(words, inputs, say=tell, **how)
    notice = "finishing the recording; again to stop at once\n"
    with contextlib.closing(source), stoppable(notice=notice) as stop:
        frames = frames or (None if getattr(source, "gaps", False) else DEFAULT_FRAMES)
        recorded = RecordedWhileWatched(
            source,
            out,
            settings=configuration.record,
            split=None if split is None else Split.parse(split),
            force=force,
        )
        with bar("recording", "frames") as shown:
            record_watched(
                recorded,
                frames=frames,
                stop=stop,
                progress=lambda done: shown.update(done, frames),
            )
    if recorded.ended and not stop():
        tell(f"ended at frame {recorded.t}: {recorded.ended}")
    say_counts(recorded)
    print_recording(out, recorded.files, as_json=as_json)
    if stop() and frames is not None and recorded.t < frames:
        ctx.exit(stop.exit_code)


def refuse_logs(words: Sequence[str]) -> None:
    """Refuse what is recorded already, and more than one scene."""
    from recorder.world.scenes import SCENES

    logs = [w for w in words if w and w not in SCENES and (Path(w).exists() or set("*?:") & set(w))]
    if logs:
        convert = f"cdmisfa convert {shlex.join(logs)} -o REC"
        raise UsageError(f"{logs[0]} is a log, no scene: write it as a recording with {convert}")
    if len(words) > 1:
        raise UsageError(f"{' '.join(words)}: record one scene at a time")


def print_recording(folder: Path, files: Sequence[ViewRecording], *, as_json: bool) -> None:
    """Print the file of each view of a recording."""
    if as_json:
        frames = sum(file.frames for file in files if file.name == files[0].name)
        rows = [file.as_json() for file in files]
        print_document(recording=str(folder), frames=frames, views=rows)
        return
    print_table(
        ("view", "file", "frames", "bytes", "sha256"),
        [(f.name, f.file, f.frames, f.bytes, f.sha256) for f in files],
    )
