"""Progress on stderr: a bar with rate and time left on a terminal, nothing elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import click


class Bar:
    """What a command reports to: how far it is, and lines worth reading."""

    def update(self, done: float, total: float | None = None, note: str = "") -> None:
        """So much is done, of so much where that is known; `note` stands behind the bar."""

    def turn_to(self, title: str, unit: str) -> None:
        """Show something else from now on."""

    def say(self, line: str) -> None:
        """A line that stays, above the bar."""
        click.echo(line, err=True)


@contextmanager
def bar(title: str, unit: str) -> Iterator[Bar]:
    """Show progress while the body runs, if anyone is looking; the unit is what is counted."""
    if not sys.stderr.isatty():
        yield Bar()
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        ProgressColumn,
        Task,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.table import Column
    from rich.text import Text

    class Rate(ProgressColumn):
        def render(self, task: Task) -> Text:
            speed = task.finished_speed or task.speed
            return Text(no_wrap=True, text="" if speed is None else f"{speed:,.0f} {unit}/s")

    progress = Progress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=16),
        TextColumn("{task.completed:,.0f}"),
        Rate(),
        TimeElapsedColumn(),
        TextColumn("passed,"),
        TimeRemainingColumn(),
        TextColumn("left"),
        TextColumn("{task.fields[note]}", table_column=Column(no_wrap=True)),
        console=Console(stderr=True),
        transient=True,
    )

    class TerminalBar(Bar):
        def update(self, done: float, total: float | None = None, note: str = "") -> None:
            progress.update(task, completed=done, total=total, note=note)

        def turn_to(self, title: str, what: str) -> None:
            nonlocal unit
            unit = what
            progress.reset(task, description=title, total=None, note="")

        def say(self, line: str) -> None:
            progress.console.print(line, markup=False, highlight=False)

    with progress:
        task = progress.add_task(title, total=None, note="")
        yield TerminalBar()
