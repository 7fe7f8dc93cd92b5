"""`cdmisfa view`: look at a run or a recording."""

from __future__ import annotations

import contextlib
import tempfile
from pathlib import Path
from typing import Any

import click

from cdmisfa.cli import options
from cdmisfa.cli.making import flag, grouped, number, word
from cdmisfa.cli.printing import say_about, tell
from cdmisfa.cli.progress import bar
from recorder.images.options import InputOptions


@grouped("view", common=("save", "web", "screenshot", "at", "tab", "every"))
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
@word("--size", "WxH", "Size of the window or screenshot, as 1600x1000.")
@number("--port", "Where --web, or a sweep, is served.", 1, 65535)
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
@word(
    "--memory-limit",
    "SIZE",
    "Most memory that the viewer takes for what it keeps.",
    default="2GB",
    show_default=True,
)
@options.look_options
@options.force
def view_command(
    run: tuple[Path, ...],
    save: Path | None,
    web: bool,
    screenshot: Path | None,
    at: str | None,
    size: str | None,
    port: int | None,
    memory_limit: str,
    force: bool,
    inputs: InputOptions,
    **shown: Any,
) -> None:
    """Open a run or a recording in the Rerun viewer, or save, serve or draw it.

    RUN is the folder of a run, or its run.mcap, a recording, an .rrd file, or one or several
    camera logs; of a log behind a URL a copy is made. A folder of runs is served as a
    table, one row per run that it was asked for last, until interrupted.
    """
    if sum((save is not None, web, screenshot is not None)) > 1:
        raise click.UsageError("choose one of --save, --web and --screenshot")
    if at is not None and save is not None:
        raise click.UsageError("a file of Rerun has no place for a moment: --at without --save")
    if size is not None and (web or save is not None):
        raise click.UsageError("--size goes with a window or --screenshot")
    from replay.runs.folders import runs_in
    from replay.viewer.program import check_limit

    check_limit(memory_limit)
    path, *beside = run
    if not beside and runs_in(path):
        if save is not None:
            raise click.UsageError(f"{path} holds many runs, which --save cannot: name one run")
        if at is not None:
            raise click.UsageError(f"{path} holds many runs: --at is a moment of one")
        _view_sweep(path, screenshot, size, shown["tab"], web=web, port=port, force=force)
        return
    if port is not None and not web:
        raise click.UsageError("--port goes with --web, or with a sweep")
    from replay.view.build import build_view  # half a second, as are those below

    shown["about"] = say_about

    if save is not None:
        build_view(path, save, force=force, beside=beside, inputs=inputs, **shown)
        tell(f"view {save}")
        return
    from replay.viewer.headless import WINDOW
    from replay.viewer.headless import screenshot as draw
    from replay.viewer.window import open_window, serve

    with contextlib.ExitStack() as until_seen:
        if beside or inputs != InputOptions():
            folder = until_seen.enter_context(tempfile.TemporaryDirectory(prefix="cdmisfa-view-"))
            built = Path(folder) / f"{path.resolve().stem}.rrd"
            build_view(path, built, beside=beside, inputs=inputs, **shown)
            path, shown = built, {}
        if screenshot is not None:
            draw(path, screenshot, at=at, force=force, window=size or WINDOW, **shown)
            tell(f"picture {screenshot}")
        elif web:
            serve(path, at=at, memory_limit=memory_limit, port=port, **shown)
        else:
            open_window(path, at=at, memory_limit=memory_limit, size=size, **shown)


def _view_sweep(
    folder: Path,
    screenshot: Path | None,
    size: str | None,
    tab: str | None,
    *,
    web: bool,
    port: int | None,
    force: bool,
) -> None:
    """Serve the table of a sweep's runs, or draw it."""
    if screenshot is not None:
        if port is not None or tab is not None:
            raise click.UsageError("a picture of a sweep's table has no --port and no --tab")
        from replay.viewer.headless import WINDOW, draw_table

        draw_table(folder, screenshot, window=size or WINDOW, force=force)
        tell(f"picture {screenshot}")
        return
    from replay.viewer.catalogue import serve_catalogue

    with bar("preparing views", "runs") as done:
        serve_catalogue(folder, port=port, tab=tab, web=web, progress=done.update)
