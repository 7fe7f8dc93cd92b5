"""`cdmisfa convert`: write camera logs of others as a recording."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING

import click

from cdmisfa.cli import options
from cdmisfa.cli.cameras import camera_options, say_about
from cdmisfa.cli.commands.record import print_recording, recording_stoppable
from cdmisfa.cli.progress import bar
from cdmisfa.core.errors import UsageError

if TYPE_CHECKING:
    from replay.camera_logs.source import Align


@click.command("convert")
@click.argument("source", nargs=-1, required=True)
@options.out("Folder of the recording.", required=True)
@camera_options
@click.option("--salvage", is_flag=True, help="Pass over damaged parts of a log.")
@click.option("--resume", is_flag=True, help="Resume an attempt that was stopped.")
@options.server_limits
@options.fsync_every
@options.force
@options.as_json
@click.pass_context
def convert_command(
    ctx: click.Context,
    source: tuple[str, ...],
    out: Path,
    topics: tuple[str, ...],
    size: tuple[int, int] | None,
    align: Align | None,
    rate: float | None,
    salvage: bool,
    resume: bool,
    fsync_every: float | None,
    force: bool,
    as_json: bool,
) -> None:
    """Write camera logs of others as a recording.

    SOURCE is MCAP files or their URLs, ROS bags, or a video or a folder of pictures for each
    stream. What was interrupted is resumed with --resume.
    """
    from cdmisfa.experiments.convert import convert
    from cdmisfa.experiments.sources import CameraOptions, open_cameras
    from recorder.log.folder import refuse_existing
    from replay.storage.location import Url, location

    places = [location(word) for word in source]
    for place in places:
        if not isinstance(place, Url) and not place.exists():
            raise UsageError(f"{place}: no such file or folder")
    if not resume:
        refuse_existing(out, force=force)
    cameras = CameraOptions(topics, size, align, rate)
    goal = ("convert", str(out))
    with contextlib.closing(open_cameras(places, cameras, salvage=salvage, goal=goal)) as frames:
        say_about(frames)
        length = frames.spec.length or 0
        with bar("converting", "frames") as shown, recording_stoppable(ctx, out) as stop:
            files = convert(
                frames,
                out,
                force=force,
                resume=resume,
                fsync_every=fsync_every,
                stop=stop,
                progress=lambda done: shown.update(done, length),
            )
    print_recording(out, files, as_json=as_json)
