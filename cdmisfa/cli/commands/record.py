"""`cdmisfa record`: write what a scene shows."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click
from click.core import ParameterSource

from cdmisfa.cli import options
from cdmisfa.cli.interrupts import Stop, stoppable
from cdmisfa.cli.progress import bar
from cdmisfa.core.errors import UsageError

if TYPE_CHECKING:
    from recorder.recording import ViewRecording

CONVERTED = ("foreign",)
"""What a recording names as its source where it was converted from camera logs."""


@click.command("record")
@click.argument("scene", nargs=-1)
@options.out("Folder of the recording.")
@click.option(
    "--frames",
    type=click.IntRange(1),
    help="Frames of each view; by default 1000, with --resume as many as first asked for.",
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
@options.force
@options.as_json
@click.pass_context
def record_command(
    ctx: click.Context,
    scene: tuple[str, ...],
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
) -> None:
    """Record what a scene shows, one MCAP file per view.

    SCENE is icub or oscillatory; --resume knows it, the seed and the split of what was begun. The
    same seed gives the same bytes.
    """
    from cdmisfa.experiments.sources import configure
    from recorder.log.begun import Begun, read_recording
    from recorder.world.scenes import SCENES

    _refuse_logs(scene)
    begun = read_recording(out) if resume and out is not None else Begun()
    if begun.source == CONVERTED:
        command = f"cdmisfa convert SOURCE -o {shlex.quote(str(out))} --resume"
        raise UsageError(f"{out} is an unfinished conversion: resume it with {command}")
    given_seed = ctx.get_parameter_source("seed") is not ParameterSource.DEFAULT
    named = "".join(scene or begun.source)
    if resume and out is not None and not (named or frames or given_seed or split):
        from recorder.recording import recorded

        if files := recorded(out):
            _say_complete(out)
            print_recording(out, files, as_json=as_json)
            return
    if not named:
        where = f"{out} does not say of what it is: " if resume and out is not None else ""
        raise click.UsageError(f"{where}name the SCENE, {' or '.join(SCENES)}")
    if not given_seed:
        seed = begun.options.get("seed", seed)
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
    from recorder.log.split import Split
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
        _say_complete(out)
    print_recording(out, files, as_json=as_json)


def _say_complete(folder: Path) -> None:
    click.echo(f"{folder} is complete: nothing was left to record", err=True)


def _refuse_logs(words: tuple[str, ...]) -> None:
    """Refuse what is recorded already, and more than one scene."""
    from recorder.world.scenes import SCENES

    logs = [w for w in words if w not in SCENES and (Path(w).exists() or set("*?:") & set(w))]
    if logs:
        convert = f"cdmisfa convert {shlex.join(logs)} -o REC"
        raise UsageError(f"{logs[0]} is a log, no scene: write it as a recording with {convert}")
    if len(words) > 1:
        raise UsageError(f"{' '.join(words)}: record one scene at a time")


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
