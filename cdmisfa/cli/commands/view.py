"""`cdmisfa view`: look at a run or a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from cdmisfa.cli import options
from cdmisfa.cli.printing import say_about, tell
from cdmisfa.core.errors import UsageError
from recorder.log.files import refuse_taken, refuse_unless


@click.command("view")
@options.log_argument("run", nargs=-1)
@options.path("--save", "F.rrd", "Write the view to a file.")
@click.option("--web", is_flag=True, help="Serve the view to a browser on this machine only.")
@options.path("--screenshot", "F.png", "Draw the view into a file, without a screen.")
@click.option(
    "--at",
    metavar="WHEN",
    help='Moment to open it at: a frame, "iteration 500", or words of an event, as "module 2".',
)
@click.option("--tab", metavar="NAME", help="Name of the open tab; by default the first.")
@click.option(
    "--port",
    type=click.IntRange(1, 65535),
    help="Port of the page of --web; by default a free one.",
)
@click.option(
    "--every",
    type=click.IntRange(1),
    metavar="N",
    show_default=True,
    default=10,
    help="Show the images of every Nth frame; numbers are all shown.",
)
@options.look_options
@options.force
def view_command(
    run: tuple[Path, ...],
    save: Path | None,
    web: bool,
    screenshot: Path | None,
    at: str | None,
    port: int | None,
    force: bool,
    **shown: Any,
) -> None:
    """Open a run or a recording in the Rerun viewer, or save, serve or draw it.

    RUN is the folder of a run, or its run.mcap, a recording, an .rrd file, or one or several
    camera logs; of a log behind a URL a copy is made.
    """
    if sum((save is not None, web, screenshot is not None)) > 1:
        raise click.UsageError("choose one of --save, --web and --screenshot")
    if at is not None and (web or save is not None):
        raise click.UsageError("--at goes with a window or --screenshot")
    if port is not None and not web:
        raise click.UsageError("--port goes with --web")
    from replay.runs.folders import runs_in

    path, *beside = run
    if not beside and runs_in(path):
        raise UsageError(f"{path} holds many runs: name one, or several to cdmisfa report")
    if screenshot is not None:
        refuse_unless(screenshot, "the screenshot is a PNG", ".png")
        refuse_taken(screenshot, force=force)
    from replay.view.build import build_view, view_of

    shown |= {"beside": beside, "about": say_about}
    if save is not None:
        build_view(path, save, force=force, **shown)
        tell(f"view {save}")
        return
    from replay.viewer import frame_at, open_window, served
    from replay.viewer import screenshot as draw

    frame = None if at is None else frame_at(path, at)
    with view_of(path, **shown) as view:
        if screenshot is not None:
            draw(view, screenshot, frame)
            tell(f"screenshot {screenshot}")
        elif web:
            with served(view, port or 0) as (server, address):
                tell(address)
                server.until_end()
        else:
            open_window(view, frame)
