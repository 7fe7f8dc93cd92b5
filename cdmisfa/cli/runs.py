"""`cdmisfa compare`, `plot` and `export`: what to do with finished runs."""

from __future__ import annotations

from pathlib import Path

import click

from cdmisfa.cli import options
from cdmisfa.errors import NotReproducedError


@click.command("compare")
@options.path_argument("first")
@options.path_argument("second")
@options.as_json
@click.pass_context
def compare_command(ctx: click.Context, first: Path, second: Path, as_json: bool) -> None:
    """Check that two runs' signals are the same, bit for bit.

    Exits with 4 where they differ, and says where they first do.
    """
    from replay.compare import compare

    difference = compare(first, second)
    if as_json:
        options.print_json(
            {
                "schema": options.SCHEMA,
                "identical": difference is None,
                "first_difference": None if difference is None else difference.as_json(),
            }
        )
    else:
        click.echo("identical, bit for bit" if difference is None else str(difference))
    if difference is not None:
        ctx.exit(NotReproducedError.exit_code)


@click.command("plot")
@options.path_argument("run")
@options.out("Folder of the figures; by default the run's own folder figures.")
@options.force
@options.as_json
def plot_command(run: Path, out: Path | None, force: bool, as_json: bool) -> None:
    """Draw the figures of a run."""
    from replay.figures import draw_figures

    files = draw_figures(run, out, force=force)
    if as_json:
        options.print_json(
            {"schema": options.SCHEMA, "run": str(run), "figures": [str(f) for f in files]}
        )
        return
    for file in files:
        click.echo(file)


@click.command("export")
@options.path_argument("path")
@click.option(
    "--to",
    "form",
    type=click.Choice(["parquet", "npz", "csv", "arrow", "images"]),
    help="Form; by default what the file's name ends in.",
)
@options.out("The file to write, for images the folder.", required=True)
@options.force
@options.as_json
def export_command(path: Path, form: str | None, out: Path, force: bool, as_json: bool) -> None:
    """Write a run's signals as a table or arrays, a recording as images.

    Signals go to one file, Parquet, CSV, Arrow or NumPy's npz, images to a folder.
    """
    from replay.export import export

    rows = export(path, out, form or out.suffix.removeprefix("."), force=force)
    if as_json:
        options.print_json(
            {"schema": options.SCHEMA, "path": str(path), "file": str(out), "rows": rows}
        )
    else:
        click.echo(f"{rows} {'images' if form == 'images' else 'iterations'} written to {out}")
