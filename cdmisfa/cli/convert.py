"""`cdmisfa convert`: make a recording of other people's camera logs."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING

import click

from cdmisfa.cli import options
from cdmisfa.cli.cameras import camera_options, say_about
from cdmisfa.cli.progress import bar
from cdmisfa.cli.record import print_recording
from cdmisfa.errors import UsageError

if TYPE_CHECKING:
    from replay.foreign import Align


@click.command("convert")
@click.argument("source", nargs=-1, required=True, type=click.Path(path_type=Path))
@options.out("Folder of the recording.", required=True)
@camera_options
@click.option("--salvage", is_flag=True, help="Go on over damaged parts of a log.")
@options.force
@options.as_json
def convert_command(
    source: tuple[Path, ...],
    out: Path,
    topics: tuple[str, ...],
    size: tuple[int, int] | None,
    align: Align | None,
    rate: float | None,
    salvage: bool,
    force: bool,
    as_json: bool,
) -> None:
    """Write camera logs of others as a recording.

    SOURCE is MCAP files, ROS bags, or a folder of pictures for each stream.
    """
    from cdmisfa.experiments.convert import convert
    from cdmisfa.experiments.sources import CameraOptions, open_cameras
    from recorder.recording import refuse_existing

    for path in source:
        if not path.exists():
            raise UsageError(f"{path}: no such file or folder")
    refuse_existing(out, force=force)
    cameras = CameraOptions(topics, size, align, rate)
    with contextlib.closing(open_cameras(source, cameras, salvage=salvage)) as frames:
        say_about(frames)
        length = frames.spec.length or 0
        with bar("converting", "frames") as shown:
            files = convert(
                frames, out, force=force, progress=lambda done: shown.update(done, length)
            )
    print_recording(out, length, files, as_json=as_json)
