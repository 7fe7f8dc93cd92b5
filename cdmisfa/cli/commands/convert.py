"""`cdmisfa convert`: write camera logs of others as a recording."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cdmisfa.cli import options, uploads
from cdmisfa.cli.cameras import (
    camera_options,
    live_options,
    live_streams,
    print_plan,
    say_about,
    say_changes,
)
from cdmisfa.cli.commands.record import (
    print_recording,
    record_streams,
    recording_stoppable,
    say_complete,
)
from cdmisfa.cli.progress import bar
from cdmisfa.core.errors import UsageError

if TYPE_CHECKING:
    from recorder.cameras.readers import OnLoss


@click.command("convert")
@click.argument("source", nargs=-1, required=True)
@uploads.out("Folder of the recording, or s3://...; --dry-run needs none.")
@camera_options
@live_options
@click.option("--salvage", is_flag=True, help="Pass over damaged parts and images of a log.")
@click.option("--resume", is_flag=True, help="Resume an attempt that was stopped.")
@options.server_limits
@options.fsync_every
@options.force
@options.as_json
@click.pass_context
def convert_command(
    ctx: click.Context,
    /,
    source: tuple[str, ...],
    out: Path | None,
    salvage: bool,
    resume: bool,
    fsync_every: float | None,
    force: bool,
    as_json: bool,
    dry_run: bool,
    hold: float,
    lost: OnLoss,
    stall: float,
    **cameras: Any,
) -> None:
    """Write camera logs of others as a recording.

    SOURCE is MCAP files or their URLs, ROS bags, LeRobot datasets, tables of numbers (CSV,
    Parquet), or a video or a folder of pictures for each stream; several, or a pattern such as
    'logs/*.mcap'. What was interrupted is resumed with --resume. Live streams are recorded, as by
    cdmisfa record.
    """
    from cdmisfa.experiments.convert import convert
    from recorder.cameras.words import is_live
    from recorder.log.files import refuse_existing
    from replay.camera_logs.options import CameraOptions
    from replay.inputs.opening import open_cameras, refuse_what_is_no_log
    from replay.inputs.words import places

    if out is None:
        if not dry_run:
            raise click.UsageError("say -o FOLDER, where the recording goes")
        out = Path("REC")  # in a command that a refusal advises
    if any(map(is_live, source)):
        if resume or salvage or dry_run:
            raise UsageError(
                "live streams cannot go back: leave out --resume, --salvage and --dry-run"
            )
        record_streams(
            ctx,
            source,
            out,
            frames=None,
            split=None,
            fsync_every=fsync_every,
            force=force,
            as_json=as_json,
            live=live_streams(hold, lost, stall),
            cameras=CameraOptions(**cameras),
        )
        return
    named = places(source)
    for place in named:
        refuse_what_is_no_log(place)
    if not resume and not dry_run:
        refuse_existing(out, force=force)
    goal = ("convert", str(out))
    opened = open_cameras(named, CameraOptions(**cameras), salvage=salvage, goal=goal)
    with contextlib.closing(opened) as frames:
        if dry_run:
            print_plan(frames, as_json=as_json)
            return
        say_about(frames)
        length, told = frames.spec.length or 0, False

        def report(done: float) -> None:
            nonlocal told
            told = True
            shown.update(done, length)

        with bar("converting", "frames") as shown, recording_stoppable(ctx, out) as stop:
            files = convert(
                frames,
                out,
                force=force,
                resume=resume,
                fsync_every=fsync_every,
                stop=stop,
                progress=report,
            )
        say_changes(frames)
    if resume and not told:
        say_complete(out)
    print_recording(out, files, as_json=as_json)
