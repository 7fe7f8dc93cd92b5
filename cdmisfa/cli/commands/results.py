"""`cdmisfa results`: what a sweep found."""

from __future__ import annotations

from pathlib import Path

import click

from cdmisfa.cli import options


@click.command("results")
@options.path_argument("folder")
@click.option("--csv", "as_csv", is_flag=True, help="Print comma-separated values.")
@click.option("--latex", "as_latex", is_flag=True, help="Print a LaTeX table (booktabs).")
@options.as_json
def results_command(folder: Path, as_csv: bool, as_latex: bool, as_json: bool) -> None:
    """Print mean and standard deviation over seeds at each point of a sweep.

    The trials are those that the sweep was asked for last.
    """
    from cdmisfa.experiments import results

    if as_csv + as_latex + as_json > 1:
        raise click.UsageError("choose one of --csv, --latex and --json")
    points = results.results(folder)
    if as_json:
        options.print_json(results.as_json(points))
    elif as_csv:
        click.echo(results.as_csv(points), nl=False)
    elif as_latex:
        click.echo(results.as_latex(points), nl=False)
    else:
        options.print_table(*results.as_table(points))
