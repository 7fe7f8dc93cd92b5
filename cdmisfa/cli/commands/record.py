"""`cdmisfa record` and `convert`: write recordings of scenes, of cameras, of logs of others."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from cdmisfa.cli import options
from cdmisfa.cli.interrupts import Stop, stoppable
from cdmisfa.cli.printing import (
    print_document,
    print_table,
    say_about,
    say_changes,
    say_counts,
    tell,
)
from cdmisfa.cli.progress import bar
from cdmisfa.core.errors import LogDamagedError, UsageError

if TYPE_CHECKING:
    from recorder.images.options import InputOptions
    from recorder.log.manifest import RecordingStart
    from recorder.recording import ViewRecording

CONVERTED = "foreign"
"""What a recording names as its source where it was converted from camera logs."""

LIVE = ("cameras", "gym")
"""What it names where it is of live streams."""


@click.command("record")
@click.argument("source", nargs=-1, type=options.WORD)
@options.out("Folder of the recording.", required=True)
@click.option(
    "--frames",
    type=click.IntRange(1),
    help="Frames of each view; by default 1000, with --resume as many as first asked for, and of "
    "cameras all until Ctrl-C.",
)
@options.seed()
@click.option("--view", "views", multiple=True, metavar="NAME", help="Only this view; repeatable.")
@options.jobs
@options.preset
@options.settings()
@click.option("--resume", is_flag=True, help="Resume an interrupted recording.")
@click.option(
    "--split",
    metavar="TIME",
    help="Begin a new file of each view after this time: 90s, 10min; by default, with --resume as "
    "first asked for.",
)
@options.input_options("fields", "size", "rate", "color")
@options.force
@options.as_json
@options.quiet
@click.pass_context
def record_command(
    ctx: click.Context,
    /,
    source: tuple[str, ...],
    out: Path,
    seed: int,
    preset: str | None,
    settings: tuple[str, ...],
    as_json: bool,
    inputs: InputOptions,
    **writing: Any,
) -> None:
    """Record what a scene or cameras show, one MCAP file per view.

    SOURCE is a scene, icub or oscillatory; the same seed gives the same bytes. With --resume it
    need not be given, nor the seed or the split: they are those of what was begun.

    Or it is live streams, one or several: camera:/dev/video0, rtsp://, http://.../x.mjpg, tcp://,
    av:ADDRESS, foxglove://HOST:PORT/TOPIC, gym:TASK. Logs of others are written by cdmisfa convert.
    """
    from cdmisfa.experiments.sources import configure
    from recorder.cameras.words import is_live
    from recorder.log.manifest import RecordingStart
    from recorder.recording import recorded
    from recorder.world.scenes import SCENES

    if any(map(is_live, source)):
        views, jobs, resume = (writing.pop(name) for name in ("views", "jobs", "resume"))
        if resume or views or jobs > 1:
            raise UsageError(
                "live streams cannot go back, and all of it is recorded: leave out --resume, "
                "--view and --jobs"
            )
        writing |= {"preset": preset, "settings": settings, "seed": seed, "as_json": as_json}
        _record_streams(ctx, source, out, inputs, **writing)
        return
    _refuse_logs(source)
    resumed = out if writing["resume"] else None
    start = RecordingStart() if resumed is None else _start(resumed)
    named = "".join(source) or start.scene
    given_seed = ctx.get_parameter_source("seed") is not ParameterSource.DEFAULT
    asked = named or given_seed or writing["frames"] or writing["split"]
    if resumed is not None and not asked and (files := recorded(resumed)):
        say_complete(resumed)
        _print_recording(resumed, files, as_json=as_json)
        return
    if not named:
        where = "" if resumed is None else f"{resumed} does not say of what it is: "
        raise click.UsageError(f"{where}name the SCENE, {' or '.join(SCENES)}")
    seed = seed if given_seed or start.seed is None else start.seed
    configuration = configure(named, preset, settings, seed, inputs)
    files = _record_scene(ctx, configuration, out, **writing)
    _print_recording(out, files, as_json=as_json)


def _record_streams(
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
    from cdmisfa.experiments.sources import open_source
    from recorder.config import parse_split
    from recorder.live import RecordedWhileWatched, record_watched
    from recorder.log.files import refuse_existing
    from recorder.recording import DEFAULT_FRAMES

    refuse_existing(out, force=force, goes_on=False)
    source, configuration = open_source(words, inputs=inputs, say=tell, **how)
    notice = "finishing the recording; again to stop at once\n"
    with contextlib.closing(source), stoppable(notice=notice) as stop:
        frames = frames or (None if getattr(source, "gaps", False) else DEFAULT_FRAMES)
        recorded = RecordedWhileWatched(
            source,
            out,
            settings=configuration.record,
            split=parse_split(split) if split else None,
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
    _print_recording(out, recorded.files, as_json=as_json)
    if stop() and frames is not None and recorded.t < frames:
        ctx.exit(stop.exit_code)


def _refuse_logs(words: Sequence[str]) -> None:
    """Refuse what is recorded already, and more than one scene."""
    from recorder.world.scenes import SCENES

    logs = [w for w in words if w and w not in SCENES and (Path(w).exists() or set("*?:") & set(w))]
    if logs:
        convert = f"cdmisfa convert {shlex.join(logs)} -o REC"
        raise UsageError(f"{logs[0]} is a log, no scene: write it as a recording with {convert}")
    if len(words) > 1:
        raise UsageError(f"{' '.join(words)}: record one scene at a time")


def _print_recording(folder: Path, files: Sequence[ViewRecording], *, as_json: bool) -> None:
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


def _start(folder: Path) -> RecordingStart:
    """How a recording was started that is to be resumed."""
    from recorder.log.manifest import read_start

    start = read_start(folder)
    if start.scene in LIVE:
        raise UsageError(
            f"{folder} is of live streams, which cannot go back: what is recorded can be read, "
            "record the rest into another folder"
        )
    if start.scene == CONVERTED:
        command = f"cdmisfa convert SOURCE -o {shlex.quote(str(folder))} --resume"
        raise UsageError(f"{folder} is an unfinished conversion: resume it with {command}")
    return start


def _record_scene(
    ctx: click.Context,
    configuration: Any,
    out: Path,
    *,
    frames: int | None,
    views: tuple[str, ...],
    split: str | None,
    resume: bool,
    **how: Any,
) -> list[ViewRecording]:
    """Record a scene, or the rest of it."""
    from recorder.config import parse_split
    from recorder.recording import DEFAULT_FRAMES, record_scene

    with recording(ctx, out, resume=resume, notice="") as (report, stop):
        return record_scene(
            configuration.scene.kind,
            out,
            configuration.scene,
            configuration.record,
            frames=frames,
            views=views or None,
            split=parse_split(split) if split else None,
            resume=resume,
            stop=stop,
            progress=lambda done: report(done, max(done, frames or DEFAULT_FRAMES)),
            **how,
        )


@click.command("convert")
@click.argument("source", nargs=-1, required=True, type=options.WORD)
@options.out("Folder of the recording.", required=True)
@options.input_options(keys=True)
@options.salvage
@click.option("--resume", is_flag=True, help="Resume an attempt that was stopped.")
@options.force
@options.as_json
@options.quiet
@click.pass_context
def convert_command(
    ctx: click.Context,
    /,
    source: tuple[str, ...],
    out: Path,
    salvage: bool,
    resume: bool,
    force: bool,
    as_json: bool,
    inputs: InputOptions,
) -> None:
    """Write camera logs of others as a recording.

    SOURCE is MCAP files or their URLs, ROS bags, LeRobot datasets, tables of numbers (CSV,
    Parquet), or a video or a folder of pictures for each stream; several, or a pattern such as
    'logs/*.mcap'. What was interrupted is resumed with --resume.
    """
    from recorder.cameras.words import is_live
    from recorder.log.files import refuse_existing
    from recorder.recording import record
    from replay.inputs import locations, open_external, refuse_what_is_no_log

    if live := next(filter(is_live, source), None):
        raise UsageError(f"{live} is a live stream: cdmisfa record {shlex.join(source)} -o REC")
    named = locations(source)
    for place in named:
        refuse_what_is_no_log(place)
    if not resume:
        refuse_existing(out, force=force)
    opened = open_external(named, inputs, salvage=salvage, goal=("convert", str(out)))
    with contextlib.closing(opened) as frames:
        say_about(frames)
        with recording(ctx, out, resume=resume) as (report, stop):
            files = record(
                frames,
                out,
                resume=resume,
                stop=stop,
                progress=lambda done: report(done, frames.spec.length or 0),
                force=force,
            )
        say_changes(frames)
    _print_recording(out, files, as_json=as_json)
    if frames.left_out:
        ctx.exit(LogDamagedError.exit_code)


def say_complete(folder: Path) -> None:
    """Say that there was nothing to resume."""
    tell(f"{folder} is complete: nothing was left to record")


@contextlib.contextmanager
def recording(
    ctx: click.Context, out: Path, *, resume: bool, **notice: Any
) -> Iterator[tuple[Callable[[float, float], None], Stop]]:
    """Show how far a recording is; a signal ends its block, says how to resume, and exits."""
    from recorder.recording import RecordingStoppedError

    nothing_left = resume

    def report(done: float, total: float) -> None:
        nonlocal nothing_left
        nothing_left = False
        shown.update(done, total)

    title = "recording" if ctx.command.name == "record" else "converting"
    with bar(title, "frames") as shown, stoppable(**notice) as stop:
        try:
            yield report, stop
        except (RecordingStoppedError, KeyboardInterrupt):
            tell(f"cdmisfa: interrupted: {out} is not finished: go on with --resume")
            ctx.exit(stop.exit_code)
    if nothing_left:
        say_complete(out)
