"""`cdmisfa demo`: the whole story in minutes."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import click

from cdmisfa.cli import options
from cdmisfa.cli.making import option
from cdmisfa.cli.printing import print_json, print_table, quoted
from cdmisfa.cli.progress import Bar, bar


@click.command("demo")
@options.out("Folder of the recordings and runs; by default the one you are in.")
@options.seed
@option(
    "--frames", type=click.IntRange(400), default=16000, show_default=True, help="Frames a view."
)
@options.jobs
@options.as_json
def demo_command(out: Path | None, seed: int, frames: int, jobs: int, as_json: bool) -> None:
    """Record, learn, check and show: the whole story in minutes.

    What an earlier demo left in the same folder is replaced.
    """
    from cdmisfa.studies.demo import demo

    report = demo(out or Path(), seed=seed, frames=frames, jobs=jobs, stage=_stage)
    if as_json:
        print_json(report)
        return
    head = ("module", "view", "policy", "iteration", "follows", "correlation")
    told = {"policy": " ".join, "correlation": "{:.3f}".format}
    rows = [[told.get(key, str)(module[key]) for key in head] for module in report["modules"]]
    print_table(head, rows)
    click.echo()
    for figure in report["figures"]:
        if figure.suffix == ".png":
            click.echo(f"figure     {figure}")
    click.echo(f"look at it {quoted(sys.argv[0])} view {quoted(report['run'])}")


@contextmanager
def _stage(title: str, unit: str) -> Iterator[Bar]:
    """Announce a stage and say how long it took, also where nobody sees a bar."""
    start = time.monotonic()
    click.echo(title, err=True)
    with bar("", unit) as shown:
        yield shown
    click.echo(f"    {time.monotonic() - start:.0f} s", err=True)
