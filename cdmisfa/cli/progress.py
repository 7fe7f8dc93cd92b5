"""How far a command is: a bar on a terminal, with what a run watches and saved last."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Iterator
from datetime import timedelta
from typing import TYPE_CHECKING

from cdmisfa.cli.interrupts import stoppable
from cdmisfa.cli.printing import Stderr, tell
from cdmisfa.core.learning import Sink
from cdmisfa.core.untrusted import printable

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.progress import Task

    from cdmisfa.cli.interrupts import Stop
    from cdmisfa.core.blocks import Block, SourceSpec
    from cdmisfa.core.learning import Learner
    from cdmisfa.core.signals import BlockSignals

TICK = 0.1
"""Seconds between two updates of the bar: a block may take only microseconds."""

BYTES, MEGABYTE, GIGABYTE = "bytes", 10**6, 10**9
"""A unit of bars that is shown in megabytes."""


class Bar:
    """What a command reports to: how far it is, and lines worth reading."""

    def update(self, done: float, total: float | None = None, note: str = "") -> None:
        """So much is done, of so much where that is known; `note` stands below the bar."""

    def turn_to(self, title: str, unit: str) -> None:
        """Show something else from now on."""

    def say(self, line: str) -> None:
        """A line that stays, above the bar."""
        tell(line)

    def sink(self, spec: SourceSpec, max_iterations: int | None, *, events: bool = True) -> Sink:
        """A sink that shows a run; see `Reporter`."""
        return Reporter(self, spec, max_iterations, events=events)


@contextlib.contextmanager
def bar(title: str, unit: str) -> Iterator[Bar]:
    """Show progress while the body runs, if anyone is looking; the unit is what is counted."""
    if Stderr.quiet or not sys.stderr.isatty():
        yield Bar()
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn
    from rich.text import Text

    class Figures(ProgressColumn):
        def render(self, task: Task) -> Text:
            return Text(figures(task, unit), no_wrap=True, overflow="ellipsis")

    class WithNote(Progress):
        note = ""

        def get_renderables(self) -> Iterator[RenderableType]:
            yield self.make_tasks_table(self.tasks)
            if self.note:
                yield Text(f"  {self.note}", no_wrap=True, overflow="ellipsis")

    progress = WithNote(
        TextColumn("{task.description}"),
        BarColumn(bar_width=16),
        Figures(),
        console=Console(stderr=True),
        transient=True,
    )

    class TerminalBar(Bar):
        def update(self, done: float, total: float | None = None, note: str = "") -> None:
            progress.note = printable(note)
            progress.update(task, completed=done, total=total)

        def turn_to(self, title: str, what: str) -> None:
            nonlocal unit
            unit, progress.note = what, ""
            progress.reset(task, description=title, total=None)

        def say(self, line: str) -> None:
            progress.console.print(printable(line), markup=False, highlight=False, emoji=False)

    with progress:
        task = progress.add_task(title, total=None)
        yield TerminalBar()


def figures(task: Task, unit: str) -> str:
    """How much of a task is done, how fast, and how long it takes, or took where nobody knows."""
    scale, digits = (MEGABYTE, 1) if unit == BYTES else (1, 0)
    done = f"{task.completed / scale:,.{digits}f}"
    if task.total is not None:
        done += f" of {task.total / scale:,.{digits}f}"
    told = [f"{done} {'MB' if unit == BYTES else unit}"]
    if (speed := task.finished_speed or task.speed) is not None:
        told.append(f"{speed / scale:,.{digits}f} a second")
    if (left := task.time_remaining) is not None:
        told.append(f"{timedelta(seconds=round(left))} left")
    elif task.elapsed is not None:
        told.append(f"{timedelta(seconds=round(task.elapsed))}")
    return ", ".join(told)


class Reporter(Sink):
    """Shows a run's progress: every module once, the rest a few times a second.

    Args:
        shown: where.
        spec: of what is learned from.
        max_iterations: after which the run ends.
        events: each is said, as a module that is saved.

    Attributes:
        told: whether any block was learned.
    """

    def __init__(
        self, shown: Bar, spec: SourceSpec, max_iterations: int | None, *, events: bool = True
    ) -> None:
        self.told = self._hashing = False
        self._events = events
        self._shown, self._spec, self._max_iterations = shown, spec, max_iterations
        self._next = 0.0

    def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
        """See `Sink`."""
        self.told = True
        for text in learner.events if self._events else ():
            self._shown.say(f"iteration {signals.iteration}: {text}")
        now = time.monotonic()
        if now >= self._next:
            self._next = now + TICK
            if self._hashing:
                self._hashing = False
                self._shown.turn_to("learning", "blocks")
            self._shown.update(
                learner.iteration, self._total(block, learner), self._note(signals, learner)
            )

    def _total(self, block: Block, learner: Learner) -> int | None:
        """Iterations of the whole run, as far as the frames last or it was told to go."""
        total = self._max_iterations
        if self._spec.length is not None:
            left = (self._spec.length - block.t - len(block.frames)) // learner.tau
            whole = learner.iteration + max(left, 0)
            total = whole if total is None else min(total, whole)
        return total

    def _note(self, signals: BlockSignals, learner: Learner) -> str:
        """What is watched, what was saved last, and how much there is to learn."""
        names, modules = self._spec.streams, learner.modules
        saved = "nothing saved yet"
        if modules:
            saved = f"saved last: module {modules[-1].index} of {modules[-1].stream}"
        learning = int((signals.state == 0).sum())
        left = (
            f"{learning} of {len(names)} being learned" if learning else f"ε {signals.epsilon:.2f}"
        )
        return f"watching {names[signals.stream]}, {saved}, {left}"

    def event(self, t: int, iteration: int, text: str, level: str = "INFO") -> None:
        """See `Sink`."""
        if level == "WARNING":
            self._shown.say(text)

    def hashing(self, done: int, size: int) -> None:
        """Show how far the source's files are hashed, once that is waited for."""
        if not self._hashing:
            self._hashing = True
            self._shown.turn_to("hashing", BYTES)
            read = f"{done / GIGABYTE:.1f} of {size / GIGABYTE:.1f} GB are read"
            self._shown.say(f"waiting for the SHA-256 of what is learned from: {read}")
        self._shown.update(done, size)


@contextlib.contextmanager
def learning(spec: SourceSpec, max_iterations: int | None) -> Iterator[tuple[Stop, Reporter]]:
    """Show the progress of a run on what is described so, and end it at a signal."""
    with bar("learning", "blocks") as shown, stoppable() as stop:
        yield stop, Reporter(shown, spec, max_iterations)
