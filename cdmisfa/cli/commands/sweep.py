"""`cdmisfa sweep` and `results`: many trials over a grid of settings and seeds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from cdmisfa.cli import options, uploads
from cdmisfa.cli.making import flag, grouped, word
from cdmisfa.cli.printing import (
    print_document,
    print_json,
    print_table,
    quoted,
    say_failed,
    tell,
)
from cdmisfa.cli.progress import bar

MOST_SEEDS = 1_000_000


@grouped("sweep", common=("out", "grid", "seeds", "settings", "max_iterations", "jobs"))
@click.argument("source", nargs=-1, required=True)
@uploads.out_option(
    "Folder of the sweep, or s3://...; what is finished in it is not computed again.",
    required=True,
    goes_on=True,
)
@word(
    "--grid",
    "KEY=V1,V2,...",
    "Values to try for a configuration key; several grids multiply.",
    multiple=True,
)
@options.seeds("Seeds of every point", "0:20")
@options.preset
@options.settings()
@options.end_after("iterations", "End each trial after so many iterations.")
@options.end_after("modules", "End each trial after so many modules.")
@options.loop
@options.log_options
@options.jobs
@options.engine
@flag("--keep-logs", "Keep the run of every trial, with its log.")
@options.retry_failed
@options.server_limits
@options.as_json
@click.pass_context
def sweep_command(
    ctx: click.Context,
    /,
    source: tuple[str, ...],
    out: Path,
    grid: tuple[str, ...],
    seeds: str,
    as_json: bool,
    **how: Any,
) -> None:
    """Learn from a source many times, over a grid of settings and seeds.

    SOURCE is what learn takes, but for live streams: record these first. A sweep that was
    stopped is resumed when it is asked for again. Look at what it found with: cdmisfa results DIR
    """
    from cdmisfa.experiments.sweep import sweep

    values, numbers = parse_grid(grid), parse_seeds(seeds)
    with bar("sweep", "trials") as shown:

        def progress(finished: int, failed: int, total: int) -> None:
            shown.update(finished, total, f"{failed} failed" if failed else "")

        try:
            report = sweep(source, out, grid=values, seeds=numbers, progress=progress, **how)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"{out} keeps the trials that are finished: say the same again to go on"
            ) from None
    failed = [{key: row[key] for key in ("id", "point", "seed", "error")} for row in report.failed]
    if report.outdated:
        tell(
            f"{report.outdated} trials that were finished before are computed again: the code "
            "of the learner or the recorder has changed since"
        )
    if as_json:
        counts = ("trials", "skipped", "computed", "outdated")
        each = {name: getattr(report, name) for name in counts}
        print_document(sweep=report.folder, **each, failed=failed)
    else:
        click.echo(
            f"{report.trials} trials: {report.computed} computed, {report.skipped} finished "
            f"before, {len(failed)} failed"
        )
        say_failed(failed)
        click.echo(f"look at it: cdmisfa results {quoted(out)}")
    if failed:
        ctx.exit(1)


def parse_grid(words: tuple[str, ...]) -> dict[str, list[str]]:
    """`KEY=V1,V2` words as values by key."""
    grid: dict[str, list[str]] = {}
    for each in words:
        key, equals, values = each.partition("=")
        found = [value.strip() for value in values.split(",") if value.strip()]
        if not (equals and key.strip() and found):
            raise click.UsageError(f"--grid {each}: write it as section.key=value,value")
        if key.strip() in grid:
            raise click.UsageError(f"--grid {key.strip()} is given twice: put all values in one")
        grid[key.strip()] = found
    return grid


def parse_seeds(text: str) -> list[int]:
    """`0:20` (without 20), `3`, or `1,5,9:12` as seeds."""
    seeds: list[int] = []
    try:
        for part in text.split(","):
            first, colon, end = part.partition(":")
            span = range(int(first), int(end) if colon else int(first) + 1)
            if not span or span[0] < 0 or len(seeds) + len(span) > MOST_SEEDS:
                raise ValueError
            seeds.extend(span)
    except ValueError:
        raise click.UsageError(f"--seeds {text}: write it as 0:20 or 1,5,9") from None
    return seeds


@click.command("results")
@options.path_argument("folder")
@flag("--csv", "Print comma-separated values.")
@flag("--latex", "Print a LaTeX table (booktabs).")
@options.as_json
def results_command(folder: Path, csv: bool, latex: bool, as_json: bool) -> None:
    """Print mean and standard deviation over seeds at each point of a sweep.

    FOLDER is that of the sweep, the trials are those that it was asked for last.
    """
    from cdmisfa.experiments import results

    if csv + latex + as_json > 1:
        raise click.UsageError("choose one of --csv, --latex and --json")
    points = results.results(folder)
    if as_json:
        print_json(results.as_json(points))
    elif csv:
        click.echo(results.as_csv(points), nl=False)
    elif latex:
        click.echo(results.as_latex(points), nl=False)
    else:
        print_table(*results.as_table(points))
