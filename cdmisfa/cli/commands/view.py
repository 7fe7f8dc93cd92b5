"""`cdmisfa view` and `report`: show runs, recordings and logs in Rerun or as an HTML page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from cdmisfa.cli import options, printing
from cdmisfa.core.errors import UsageError


@options.command("view")
@options.log_argument("run", "PATH...")
@options.option("--save F.rrd", type=options.LOCAL)
@options.option("--web")
@options.option("--screenshot F.png", type=options.LOCAL)
@options.option("--at WHEN")
@options.option("--tab NAME")
@options.option("--port N", type=options.Number(1, 65535))
@options.option("--every N", show_default=True, default=10)
@options.inputs("topics", "fields", "rate", "settings")
@options.force
def view_command(
    run: tuple[Path, ...],
    save: Path | None,
    web: bool,
    screenshot: Path | None,
    at: str | None,
    port: int | None,
    force: bool,
    **content: Any,
) -> None:
    """Show a run, recording or log in the Rerun viewer.

    The viewer opens in a window, with --web in a browser on this machine. --save and --screenshot
    write a file instead.

    PATH is one of:
        {run}
        {recording}
        {logs}
        {url}
        {view}

    Options:
        --topic TOPIC: Read this topic of a log, or all that match a pattern such as '/cam*'; each
            becomes a stream. Repeatable. [default: all with images]
        --save F.rrd: Write the view to this file.
        --web: Show the view in a browser on this machine.
        --screenshot F.png: Draw the view into this image file; needs no screen.
        --at WHEN: Open the view at this frame, at "iteration 500", or at an event, such as "module
            2". [default: end of the run]
        --tab NAME: Open this tab of the view. [default: the first]
        --port N: Port of --web on this machine. [default: a free one]
        --every N: Show every Nth image; curves show every value.

    Examples:
        cdmisfa view runs/kitchen
        cdmisfa view left.mcap right.mcap --save logs.rrd
        cdmisfa view runs/kitchen --at "module 2" --screenshot kitchen.png
    """
    if sum((save is not None, web, screenshot is not None)) > 1 or (at and (web or save)):
        raise click.UsageError(
            "choose one of --save, --web and --screenshot; --at needs a window or --screenshot"
        )
    from recorder.log.files import refuse_taken, refuse_unless
    from replay.runs.folders import runs_in

    path, *beside = run
    if not beside and runs_in(path):
        raise UsageError(f"{path} holds several runs: view one of them, or use cdmisfa report")
    if screenshot is not None:
        refuse_unless(screenshot, "the screenshot is a PNG", ".png")
        refuse_taken(screenshot, force=force)
    from replay.view.build import build_view, view_of

    content |= {"beside": beside, "about": printing.source}
    if save is not None:
        build_view(path, save, force=force, **content)
        printing.status(f"view written to {save}")
        return
    from replay.viewer import frame_at, open_window, served
    from replay.viewer import screenshot as draw

    frame = None if at is None else frame_at(path, at)
    with view_of(path, **content) as view:
        if screenshot is not None:
            draw(view, screenshot, frame)
            printing.status(f"screenshot written to {screenshot}")
        elif web:
            with served(view, port or 0) as (server, address):
                printing.status(address)
                server.until_end()
        else:
            open_window(view, frame)


@options.command("report")
@options.log_argument("run")
@options.output("HTML file to write. [default: report.html in the folder of a single run]")
@options.force
@options.as_json
def report_command(run: tuple[Path, ...], output: Path | None, force: bool, as_json: bool) -> None:
    """Write an HTML report of one or several runs.

    The page shows what was learned and when, which stream the learner attended to, why the run
    ended, and whether it is reproducible. It is one file and needs no network. cdmisfa learn writes
    the same page as report.html into its run. The page of a damaged run shows its readable part;
    the exit code is then 3.

    RUN is one of:
        {run}
        {runs}

    Examples:
        cdmisfa report runs/kitchen
        cdmisfa report runs/kitchen runs/desk -o compared.html
        cdmisfa report runs -o all.html
    """
    from cdmisfa.experiments.reports import write_report
    from replay.storage.location import with_urls

    if output is None and any(with_urls(str(path)) != str(path) for path in run):
        raise click.UsageError("the run is at a URL: name the report to write with -o F.html")
    page = write_report(run, output, force=force)
    if as_json:
        printing.document(report=page, bytes=page.stat().st_size)
    else:
        printing.line(f"report written to {page}")
