"""`cdmisfa demo`: the whole story on one scene."""

from __future__ import annotations

from pathlib import Path

import click

from cdmisfa.cli import options
from cdmisfa.cli.progress import bar


@click.command("demo")
@options.out("Folder of the recordings and runs; by default the one you are in.")
@options.seed
@click.option(
    "--frames", type=click.IntRange(400), default=16000, show_default=True, help="Frames a view."
)
@options.jobs
@options.as_json
def demo_command(out: Path | None, seed: int, frames: int, jobs: int, as_json: bool) -> None:
    """Record, learn, check and show: the whole story in minutes.

    What an earlier demo left in the same folder is replaced.
    """
    from cdmisfa.experiments.demo import demo

    report = demo(out or Path(), seed=seed, frames=frames, jobs=jobs, stage=bar)
    if as_json:
        options.print_json(report.as_json())
    else:
        click.echo(report.text())
