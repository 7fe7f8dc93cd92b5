"""Record live streams, all that they show or what is novel of it."""

from __future__ import annotations

import contextlib
import dataclasses
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cdmisfa.cli import options
from cdmisfa.cli.interrupts import stoppable
from cdmisfa.cli.printing import print_document, print_table, say_counts, tell
from cdmisfa.cli.progress import bar
from cdmisfa.core.errors import UsageError
from cdmisfa.core.names import counted

if TYPE_CHECKING:
    from cdmisfa.core.blocks import FrameSource
    from recorder.cameras.options import LiveOptions, TriggerOptions
    from recorder.images.options import ImageOptions
    from recorder.recording import ViewRecording
    from replay.corpus.judging import Applies


def record_streams(
    ctx: click.Context,
    words: Sequence[str],
    out: Path,
    live: LiveOptions,
    images: ImageOptions,
    trigger: TriggerOptions,
    *,
    as_json: bool,
    force: bool,
    frames: int | None = None,
    split: str | None = None,
    **how: Any,
) -> None:
    """Record live streams until there are so many frames, they end, or Ctrl-C."""
    from recorder.config import Split
    from recorder.live import RecordedWhileWatched, record_watched
    from recorder.log.files import refuse_existing
    from recorder.recording import DEFAULT_FRAMES

    refuse_existing(out, force=force, goes_on=False)
    known = None
    if trigger.known is not None:
        from cdmisfa.experiments.apply import Application

        known = Application(trigger.known)
        if images.size is None:
            images = dataclasses.replace(images, **known.made(images))
    source, configuration = _opened(words, live, images, **how)
    if known is not None:
        from replay.stored import centre_as

        centre_as(known.recipe.centre, source, words[0])
    triggered = None
    notice = "finishing the recording; again to stop at once\n"
    with contextlib.closing(source), stoppable(notice=notice) as stop:
        frames = frames or (None if getattr(source, "gaps", False) else DEFAULT_FRAMES)
        if trigger.when is not None:
            source = triggered = _triggered(source, trigger, known, frames)
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
    more = {}
    if triggered is not None:
        more["triggered"] = told = triggered.triggered()
        kept = f"{told['kept']} of {counted(told['watched'], 'frame')} ({told['share']:.1%})"
        tell(f"kept {kept} in {counted(len(told['segments']), 'segment')}")
    print_recording(out, recorded.files, as_json=as_json, **more)
    if stop() and frames is not None and recorded.t < frames:
        ctx.exit(stop.exit_code)


def _opened(
    words: Sequence[str],
    live: LiveOptions,
    images: ImageOptions,
    preset: str | None = None,
    settings: Sequence[str] = (),
) -> tuple[FrameSource, Any]:
    """Live streams, or a scene, and the configuration that goes with them."""
    from cdmisfa.experiments.sources import configure, is_scene, of_scene, open_cameras_now
    from recorder.cameras.words import is_live
    from recorder.world.scenes import SCENES

    if any(map(is_live, words)):
        how: dict[str, Any] = {"preset": preset, "settings": settings}
        return open_cameras_now(words, live, cameras=images, say=tell, **how)
    refuse_logs(words)
    if not words:
        raise click.UsageError(f"name the SCENE, {' or '.join(SCENES)}, or live streams")
    is_scene(words, images)  # which refuses options of cameras
    options.refuse_live_options(live, words)
    scene = configure(words[0], preset, of_scene(settings, images), live.seed)
    return scene.open_scene(), scene


def _triggered(
    source: FrameSource, trigger: TriggerOptions, known: Applies | None, frames: int | None
) -> Any:
    """What is novel of a source."""
    from replay.corpus.triggered import TriggeredSource

    return TriggeredSource(
        source,
        before=trigger.before,
        after=trigger.after,
        known=known,
        known_as=None if trigger.known is None else str(trigger.known),
        frames=frames,
        say=tell,
    )


def refuse_logs(words: Sequence[str]) -> None:
    """Refuse what is recorded already, and more than one scene."""
    from recorder.world.scenes import SCENES

    logs = [w for w in words if w and w not in SCENES and (Path(w).exists() or set("*?:") & set(w))]
    if logs:
        convert = f"cdmisfa convert {shlex.join(logs)} -o REC"
        raise UsageError(f"{logs[0]} is a log, no scene: write it as a recording with {convert}")
    if len(words) > 1:
        raise UsageError(f"{' '.join(words)}: record one scene at a time")


def print_recording(
    folder: Path, files: Sequence[ViewRecording], *, as_json: bool, **more: Any
) -> None:
    """Say what was written: each view's file."""
    if as_json:
        frames = sum(file.frames for file in files if file.name == files[0].name)
        rows = [file.as_json() for file in files]
        print_document(recording=str(folder), frames=frames, **more, views=rows)
        return
    print_table(
        ("view", "file", "frames", "bytes", "sha256"),
        [(f.name, f.file, f.frames, f.bytes, f.sha256) for f in files],
    )
