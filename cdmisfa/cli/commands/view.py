"""`cdmisfa view`: look at a run or a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from cdmisfa.cli import options
from cdmisfa.cli.making import flag, grouped, number, word
from cdmisfa.cli.printing import say_about, tell
from cdmisfa.core.errors import UsageError
from recorder.log.files import refuse_taken, refuse_unless


@grouped("view", common=("save", "web", "screenshot", "at", "tab"))
@options.log_argument("run", nargs=-1)
@options.path("--save", "Write the view to a file.", "F.rrd")
@flag("--web", "Serve the view to a browser on this machine only.")
@options.path("--screenshot", "Draw the view into a file, without a screen.", "F.png")
@word(
    "--at",
    "WHEN",
    'Moment to open it at: a frame, "iteration 500", or words of an event, as "module 2".',
)
@word("--tab", "NAME", "Name of the open tab; by default the first.")
@number("--port", "Port of the page of --web; by default a free one.", 1, 65535)
@number(
    "--every",
    "Show the images of every Nth frame; numbers are all shown.",
    *(1, None, "N"),
    default=10,
)
@options.path(
    "--all-views",
    "Also show what was not watched, from the recording that the run learned from.",
    "RECORDING",
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
