"""`cdmisfa arena`: learners compared on sets of streams."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from cdmisfa.cli import options
from cdmisfa.cli.commands.sweep import parse_seeds
from cdmisfa.cli.making import option
from cdmisfa.cli.printing import SCHEMA, print_json, print_table
from cdmisfa.cli.progress import bar

ALL = "all"


@click.command("arena")
@click.argument("sets", nargs=-1, metavar="[SET]...")
@option("--learners", metavar="NAME,...", help="Which learners [default: all].")
@option(
    "--seeds",
    default="0:10",
    show_default=True,
    metavar="FIRST:END",
    help="Seeds of learners and streams: a range without its end, or numbers with commas, as "
    "1,5,9.",
)
@options.out("Folder of the results; what is finished in it is not computed again [default: arena]")
@option("--streams", type=options.OUT, help="Folder of the streams [default: OUT/streams].")
@option(
    "--frames",
    type=click.IntRange(1),
    help="Stop a run after so many frames, instead of the set's number.",
)
@options.settings
@options.jobs
@options.engine
@options.retry_failed
@option("--page", type=options.OUT, help="Write this Markdown page of all results in OUT.")
@options.as_json
@click.pass_context
def arena_command(
    ctx: click.Context,
    /,
    sets: tuple[str, ...],
    learners: str | None,
    seeds: str,
    out: Path | None,
    page: Path | None,
    as_json: bool,
    **each: Any,
) -> None:
    """Compare learners on sets of streams: what they learn, and how soon.

    SET is one of those that docs/arena.md lists, or all; without one the six of the public suite
    are run, or, with --page, the page made from the results that are there. Most sets need the
    extra [arena]; the set small needs nothing.
    """
    from cdmisfa.studies.arena.page import arena_table, draw_curves, write_arena_page
    from cdmisfa.studies.arena.results import arena_results

    folder = out or Path("arena")
    failed = () if page is not None and not sets else _run(folder, sets, learners, seeds, each)
    document = arena_results(folder)
    figure, _ = draw_curves(document, folder)
    if page is not None:
        write_arena_page(document, figure, page)
    click.echo(f"figure {figure}" + (f", page {page}" if page is not None else ""), err=True)
    if as_json:
        print_json(document | {"schema": SCHEMA, "folder": folder})
    else:
        print_table(*arena_table(document))
    for row in failed:
        at = " ".join(f"{key}={value}" for key, value in row["point"].items())
        click.echo(f"failed: {at} seed {row['seed']}: {row['error']}", err=True)
    if failed:
        ctx.exit(1)


def _run(
    folder: Path, sets: tuple[str, ...], learners: str | None, seeds: str, each: dict[str, Any]
) -> Any:
    """Compute what is missing; the rows of the trials that failed."""
    from cdmisfa.studies.arena.arena import run_arena
    from cdmisfa.studies.arena.streams import SETS, SUITE

    names = [name for word in sets for name in (SETS if word == ALL else (word,))]
    chosen = [name.strip() for name in (learners or "").split(",") if name.strip()]
    with bar("arena", "trials") as shown:
        report = run_arena(
            folder,
            names or SUITE,
            chosen,
            parse_seeds(seeds),
            making=lambda done, total, note: shown.update(done, total, "streams, made first"),
            progress=shown.update,
            **each,
        )
    again = f" ({report.outdated} again: the code has changed since)" if report.outdated else ""
    click.echo(
        f"{report.trials} trials: {report.computed} computed{again}, {report.skipped} finished "
        f"before, {len(report.failed)} failed",
        err=True,
    )
    return report.failed
