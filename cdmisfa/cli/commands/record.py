"""`cdmisfa record`: write what a scene or cameras show."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from cdmisfa.cli import options, uploads
from cdmisfa.cli.cameras import frame_options, live_options, live_streams, say_counts, tell
from cdmisfa.cli.interrupts import Stop, stoppable
from cdmisfa.cli.progress import bar
from cdmisfa.core.errors import UsageError

if TYPE_CHECKING:
    from recorder.cameras.readers import OnLoss
    from recorder.cameras.words import LiveOptions
    from recorder.recording import ViewRecording
    from replay.camera_logs.options import CameraOptions

CONVERTED = "foreign"
"""What a recording names as its source where it was converted from camera logs."""

LIVE = ("cameras", "gym")
"""What it names where it is of live streams."""


@click.command("record")
@click.argument("source", nargs=-1)
@uploads.out("Folder of the recording, or s3://...")
@click.option(
    "--frames",
    type=click.IntRange(1),
    help="Frames of each view; by default 1000, with --resume as many as first asked for, of "
    "cameras until Ctrl-C.",
)
@options.seed
@click.option("--view", "views", multiple=True, metavar="NAME", help="Only this view; repeatable.")
@options.jobs
@options.preset
@options.settings
@click.option(
    "--scene-picture",
    type=options.OUT,
    metavar="F.png",
    help="Draw the scene from outside instead of recording it.",
)
@click.option("--resume", is_flag=True, help="Resume an interrupted recording.")
@click.option(
    "--split",
    metavar="LIMIT",
    help="Begin a new file of each view at this size or duration: 512MB, 10min; by default, with "
    "--resume as first asked for.",
)
@options.fsync_every
@frame_options
@live_options
@options.force
@options.as_json
@click.pass_context
def record_command(
    ctx: click.Context,
    /,
    source: tuple[str, ...],
    out: Path | None,
    frames: int,
    seed: int,
    views: tuple[str, ...],
    jobs: int,
    preset: str | None,
    settings: tuple[str, ...],
    scene_picture: Path | None,
    fsync_every: float | None,
    force: bool,
    resume: bool,
    split: str | None,
    as_json: bool,
    hold: float,
    lost: OnLoss,
    stall: float,
    **framing: Any,
) -> None:
    """Record what a scene or cameras show, one MCAP file per view.

    SOURCE is a scene, icub or oscillatory; the same seed gives the same bytes. With --resume it
    need not be given, nor the seed or the split: they are those of what was begun.

    Or it is live streams, one or several: camera:/dev/video0, rtsp://, http://.../x.mjpg, tcp://,
    av:ADDRESS, foxglove://HOST:PORT/TOPIC, gym:TASK. Logs of others are written by cdmisfa convert.
    """
    from cdmisfa.experiments.sources import configure, is_scene
    from recorder.cameras.words import is_live
    from recorder.log.manifest import RecordingStart, read_start
    from recorder.world.scenes import SCENES
    from replay.camera_logs.options import CameraOptions

    cameras = CameraOptions(**framing)
    if any(map(is_live, source)):
        if resume or views or jobs > 1 or scene_picture is not None:
            raise UsageError(
                "live streams cannot go back, and are recorded all: leave out --resume, --view, "
                "--jobs and --scene-picture"
            )
        if out is None:
            raise click.UsageError("say -o FOLDER, where the recording goes")
        record_streams(
            ctx,
            source,
            out,
            frames=frames,
            split=split,
            fsync_every=fsync_every,
            force=force,
            as_json=as_json,
            live=live_streams(hold, lost, stall, seed=seed),
            cameras=cameras,
            preset=preset,
            settings=settings,
        )
        return
    _refuse_logs(source)
    start = read_start(out) if resume and out is not None else RecordingStart()
    if start.scene in LIVE:
        raise UsageError(
            f"{out} is of live streams, which cannot go back: what is recorded can be read, record "
            "the rest into another folder"
        )
    if start.scene == CONVERTED:
        command = f"cdmisfa convert SOURCE -o {shlex.quote(str(out))} --resume"
        raise UsageError(f"{out} is an unfinished conversion: resume it with {command}")
    given_seed = ctx.get_parameter_source("seed") is not ParameterSource.DEFAULT
    named = "".join(source) or start.scene
    is_scene([named], cameras)  # which refuses options of cameras
    if resume and out is not None and not (named or frames or given_seed or split):
        from recorder.recording import recorded

        if files := recorded(out):
            say_complete(out)
            print_recording(out, files, as_json=as_json)
            return
    if not named:
        where = f"{out} does not say of what it is: " if resume and out is not None else ""
        raise click.UsageError(f"{where}name the SCENE, {' or '.join(SCENES)}")
    if not given_seed:
        seed = seed if start.seed is None else start.seed
    configuration = configure(named, preset, settings, seed)
    if scene_picture is not None:
        from recorder.recording import save_picture

        save_picture(named, configuration.scene, scene_picture, force=force)
        click.echo(f"picture {scene_picture}", err=True)
        if out is None:
            if as_json:
                options.print_json({"schema": options.SCHEMA, "picture": str(scene_picture)})
            return
    if out is None:
        raise click.UsageError("say -o FOLDER, where the recording goes")
    from recorder.config import Split
    from recorder.recording import DEFAULT_FRAMES, record_scene

    parts = None if split is None else Split.parse(split)
    nothing_left = resume

    def report(done: float) -> None:
        nonlocal nothing_left
        nothing_left = False
        shown.update(done, max(done, frames or DEFAULT_FRAMES))

    with bar("recording", "frames") as shown, recording_stoppable(ctx, out, notice="") as stop:
        files = record_scene(
            named,
            out,
            configuration.scene,
            configuration.record,
            frames=frames,
            views=views or None,
            jobs=jobs,
            force=force,
            resume=resume,
            split=parts,
            fsync_every=fsync_every,
            stop=stop,
            progress=report,
        )
    if nothing_left:
        say_complete(out)
    print_recording(out, files, as_json=as_json)


def say_complete(folder: Path) -> None:
    """Say that there was nothing to resume."""
    click.echo(f"{folder} is complete: nothing was left to record", err=True)


def _refuse_logs(words: tuple[str, ...]) -> None:
    """Refuse what is recorded already, and more than one scene."""
    from recorder.world.scenes import SCENES

    logs = [w for w in words if w and w not in SCENES and (Path(w).exists() or set("*?:") & set(w))]
    if logs:
        convert = f"cdmisfa convert {shlex.join(logs)} -o REC"
        raise UsageError(f"{logs[0]} is a log, no scene: write it as a recording with {convert}")
    if len(words) > 1:
        raise UsageError(f"{' '.join(words)}: record one scene at a time")


def record_streams(
    ctx: click.Context,
    words: Sequence[str],
    out: Path,
    *,
    frames: int | None,
    split: str | None,
    fsync_every: float | None,
    force: bool,
    as_json: bool,
    live: LiveOptions,
    cameras: CameraOptions,
    preset: str | None = None,
    settings: Sequence[str] = (),
) -> None:
    """Record live streams until there are so many frames, they end, or Ctrl-C."""
    from cdmisfa.experiments.sources import open_cameras_now
    from recorder.config import Split
    from recorder.live import RecordedWhileWatched, record_watched
    from recorder.log.files import refuse_existing
    from recorder.recording import DEFAULT_FRAMES

    refuse_existing(out, force=force, goes_on=False)
    with stoppable(notice="finishing the recording; again to stop at once\n") as stop:
        source, configuration = open_cameras_now(
            words,
            live,
            cameras=cameras,
            preset=preset,
            settings=settings,
            say=tell,
            stop=stop,
        )
        with contextlib.closing(source):
            recorded = RecordedWhileWatched(
                source,
                out,
                settings=configuration.record,
                split=None if split is None else Split.parse(split),
                fsync_every=fsync_every,
                force=force,
            )
            frames = frames or (None if recorded.gaps else DEFAULT_FRAMES)
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


@contextlib.contextmanager
def recording_stoppable(ctx: click.Context, out: Path, **notice: str) -> Iterator[Stop]:
    """Let the body end its block at a signal, say how to resume, and exit with its code."""
    from recorder.recording import RecordingStoppedError

    with stoppable(**notice) as stop:
        try:
            yield stop
        except (RecordingStoppedError, KeyboardInterrupt):
            line = f"cdmisfa: interrupted: {out} is not finished: go on with --resume"
            click.echo(line, err=True)
            ctx.exit(stop.exit_code)


def print_recording(folder: Path, files: Sequence[ViewRecording], *, as_json: bool) -> None:
    """Say what was written: each view's file."""
    if as_json:
        frames = sum(file.frames for file in files if file.name == files[0].name)
        rows = [file.as_json() for file in files]
        options.print_json(
            {"schema": options.SCHEMA, "recording": str(folder), "frames": frames, "views": rows}
        )
        return
    options.print_table(
        ("view", "file", "frames", "bytes", "sha256"),
        [(f.name, f.file, f.frames, f.bytes, f.sha256) for f in files],
    )
