"""Progress on stderr: a bar with rate and time left on a terminal, elsewhere lines only."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING

from cdmisfa.cli.interrupts import stoppable
from cdmisfa.cli.printing import print_result, tell
from cdmisfa.core.learning import Sink

if TYPE_CHECKING:
    from cdmisfa.cli.interrupts import Stop
    from cdmisfa.core.blocks import Block
    from cdmisfa.core.learning import Learner
    from cdmisfa.core.signals import BlockSignals


MEGABYTE, GIGABYTE = 10**6, 10**9

TICK = 0.1
"""Seconds between two updates of the bar: a block may take only microseconds."""


class Bar:
    """What a command reports to: how far it is, and lines worth reading."""

    def update(self, done: float, total: float | None = None, note: str = "") -> None:
        """So much is done, of so much where that is known; `note` stands behind the bar."""

    def turn_to(self, title: str, unit: str) -> None:
        """Show something else from now on."""

    def say(self, line: str) -> None:
        """A line that stays, above the bar."""
        tell(line)


@contextlib.contextmanager
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


class Reporter(Sink):
    """Shows a run's progress: every module once, the rest a few times a second.

    Attributes:
        told: whether any block was learned.
    """

    def __init__(self, shown: Bar, max_iterations: int | None) -> None:
        self.told = self._hashing = False
        self._shown, self._max_iterations = shown, max_iterations
        self._next = 0.0

    def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
        """See `Sink`."""
        self.told, modules = True, len(learner.modules)
        for text in learner.events:
            self._shown.say(f"iteration {signals.iteration}: {text}")
        now = time.monotonic()
        if now >= self._next:
            self._next = now + TICK
            if self._hashing:
                self._hashing = False
                self._shown.turn_to("learning", "blocks")
            learning = int((signals.state == 0).sum())
            left = f"{learning} being learned" if learning else f"ε {signals.epsilon:.2f}"
            note = f"{modules} saved, {left}"
            self._shown.update(learner.iteration, self._max_iterations, note)

    def hashing(self, done: int, size: int) -> None:
        """Show how far the source's files are hashed, once that is waited for."""
        if not self._hashing:
            self._hashing = True
            self._shown.turn_to("hashing", "MB")
            read = f"{done / GIGABYTE:.1f} of {size / GIGABYTE:.1f} GB are read"
            self._shown.say(f"waiting for the SHA-256 of what is learned from: {read}")
        self._shown.update(done / MEGABYTE, size / MEGABYTE)


@contextlib.contextmanager
def learning(max_iterations: int | None, *, as_json: bool) -> Iterator[tuple[Stop, Reporter]]:
    """Show the progress of a run, end it at a signal, and print its result if its source ended."""
    from cdmisfa.experiments.run_folder import RunExhaustedError

    try:
        with bar("learning", "blocks") as shown, stoppable() as stop:
            yield stop, Reporter(shown, max_iterations)
    except RunExhaustedError as error:
        print_result(error.result, as_json=as_json)
        raise
