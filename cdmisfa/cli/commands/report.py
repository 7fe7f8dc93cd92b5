"""`cdmisfa report`: one HTML page that says what came of a run, and needs nothing but a browser."""

from __future__ import annotations

from pathlib import Path

import click

from cdmisfa.cli import options
from cdmisfa.cli.printing import print_document, print_line, quoted, warn
from cdmisfa.core.errors import one_line
from replay.storage.location import with_urls


@click.command("report")
@options.log_argument("run", nargs=-1)
@options.out("The page, *.html; by default report.html in the folder of the one run.")
@options.force
@options.as_json
def report_command(
    run: tuple[Path, ...],
    out: Path | None,
    force: bool,
    as_json: bool,
) -> None:
    """Write what came of a run as one HTML page, to be read, printed or sent.

    RUN is the folder of a run; several runs, which are compared; or a folder of
    runs. The page needs no network and no other file: what was
    learned, when, where the learner looked, why it ended, what each module tells apart, and whether
    that can be computed again. `learn` writes that of its run as report.html.
    """
    from cdmisfa.experiments.reports import write_report

    if out is None and any(with_urls(str(path)) != str(path) for path in run):
        raise click.UsageError("of what is behind a URL say where the report goes: -o F.html")
    page = write_report(run, out, force=force)
    if as_json:
        print_document(report=page, bytes=page.stat().st_size)
    else:
        print_line(page)


def report_beside(run: str, *, quiet: bool) -> None:
    """Write the report of a run that has just ended; where that fails it is said, and no more.

    Args:
        run: its folder.
        quiet: do not print where it is.
    """
    from cdmisfa.experiments.reports import write_report

    try:
        page = write_report([run])
    except Exception as error:  # what was learned is there, whatever a page about it meets
        warn(f"{run} has no report ({one_line(error)}): cdmisfa report {quoted(run)} says why")
        return
    if not quiet:
        print_line(f"report {page}")
