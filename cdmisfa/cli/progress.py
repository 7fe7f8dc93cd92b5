"""Show the progress of a command: a bar on a terminal, with the stream a run attends to."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cdmisfa.cli.printing import Stderr, status
from cdmisfa.core.interrupts import stoppable
from cdmisfa.core.learning import Sink
from cdmisfa.core.untrusted import printable

if TYPE_CHECKING:
    from rich.console import RenderableType

    from cdmisfa.core.blocks import Block, FrameSource, SourceSpec
    from cdmisfa.core.interrupts import Stop
    from cdmisfa.core.learning import Learner
    from cdmisfa.core.signals import BlockSignals

# Seconds between two updates of the bar: a block may take only microseconds.
TICK = 0.1

GIGABYTE = 10**9


class Bar:
    """Progress of a command without a terminal: only messages are printed."""

    def update(self, done: float, total: float | None = None, note: str = "") -> None:
        """Show the amount of work done, the total if it is known, and a note below the bar."""

    def restart(self, title: str, unit: str) -> None:
        """Start the bar again for another step."""

    def say(self, line: str) -> None:
        """Print a message above the bar."""
        status(line)

    def trials(self, finished: int, failed: int, total: int) -> None:
        """Show the number of finished and failed trials or logs."""
        self.update(finished, total, f"{failed} failed" if failed else "")

    def sink(self, spec: SourceSpec, max_iterations: int | None, *, events: bool = True) -> Sink:
        """Return a sink that shows the progress of a run; see `RunProgress`."""
        return RunProgress(self, spec, max_iterations, events=events)


@contextlib.contextmanager
def bar(title: str, unit: str) -> Iterator[Bar]:
    """Show progress on a terminal while the body runs, counted in `unit`."""
    if Stderr.quiet or not sys.stderr.isatty():
        yield Bar()
        return
    from rich import progress as rich_progress
    from rich.console import Console
    from rich.text import Text

    class ProgressWithNote(rich_progress.Progress):
        note = ""

        def get_renderables(self) -> Iterator[RenderableType]:
            yield self.make_tasks_table(self.tasks)
            if self.note:
                yield Text(f"  {self.note}", no_wrap=True, overflow="ellipsis")

    progress = ProgressWithNote(
        rich_progress.TextColumn("{task.description}"),
        rich_progress.BarColumn(bar_width=16),
        rich_progress.MofNCompleteColumn(),
        rich_progress.TextColumn("{task.fields[unit]}"),
        rich_progress.TimeRemainingColumn(elapsed_when_finished=True),
        console=Console(stderr=True),
        transient=True,
    )

    class TerminalBar(Bar):
        def update(self, done: float, total: float | None = None, note: str = "") -> None:
            progress.note = printable(note)
            progress.update(task, completed=done, total=total)

        def restart(self, title: str, unit: str) -> None:
            progress.note = ""
            progress.reset(task, description=title, total=None, unit=unit)

        def say(self, line: str) -> None:
            progress.console.print(printable(line), markup=False, highlight=False, emoji=False)

    with progress:
        task = progress.add_task(title, total=None, unit=unit)
        yield TerminalBar()


@contextlib.contextmanager
def resumable_bar(out: Path, title: str, unit: str) -> Iterator[Bar]:
    """Show progress; on a signal, print that the same command continues."""
    try:
        with bar(title, unit) as progress_bar:
            yield progress_bar
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"finished results are in {out}: run the same command again"
        ) from None


class RunProgress(Sink):
    """Sink that shows the progress of a run: each event once, numbers every `TICK` seconds.

    Args:
        display: the bar that is updated.
        spec: specification of the source.
        max_iterations: limit of the run, if it has one.
        events: also print events, such as a saved module.
        source: the source, whose passes are shown.
    """

    def __init__(
        self,
        display: Bar,
        spec: SourceSpec,
        max_iterations: int | None,
        *,
        events: bool = True,
        source: Any = None,
    ) -> None:
        self._source = source
        self._bar, self._spec, self._events = display, spec, events
        self._max_iterations = max_iterations
        self._next_update = 0.0
        self._hashing = False

    def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
        """Show a block."""
        for text in learner.events if self._events else ():
            self._bar.say(f"iteration {signals.iteration}: {text}")
        now = time.monotonic()
        if now >= self._next_update:
            self._next_update = now + TICK
            if self._hashing:
                self._hashing = False
                self._bar.restart("learning", "blocks")
            total = self._total(block, learner)
            self._bar.update(learner.iteration, total, self._note(signals, learner))

    def _total(self, block: Block, learner: Learner) -> int | None:
        """Return the iterations of the whole run: until the source or the limit ends it."""
        if self._spec.length is None:
            return self._max_iterations
        left = (self._spec.length - block.t - len(block.frames)) // learner.tau
        total = learner.iteration + max(left, 0)
        return total if self._max_iterations is None else min(total, self._max_iterations)

    def _note(self, signals: BlockSignals, learner: Learner) -> str:
        """Return the attended stream, the last module, and the number of undecided streams."""
        streams, modules = self._spec.streams, learner.modules
        saved = "no module yet"
        if modules:
            saved = f"last module: {modules[-1].index} of {modules[-1].stream}"
        learning = int((signals.state == 0).sum())
        left = f"ε {signals.epsilon:.2f}"
        if learning:
            left = f"{learning} of {len(streams)} streams not decided"
        most = getattr(self._source, "passes", 1)
        at = f"pass {self._source.passes_begun} of at most {most}, " if most > 1 else ""
        return f"{at}attending to {streams[signals.stream]}, {saved}, {left}"

    def event(self, t: int, iteration: int, text: str, level: str = "INFO") -> None:
        """Print a warning."""
        if level == "WARNING":
            self._bar.say(text)

    def hashing(self, done: int, size: int) -> None:
        """Show how many bytes of the source's files are hashed while the run waits for that."""
        if not self._hashing:
            self._hashing = True
            self._bar.restart("hashing", "MB")
            self._bar.say(
                f"computing the SHA-256 of the source: {done / GIGABYTE:.1f} of "
                f"{size / GIGABYTE:.1f} GB read"
            )
        self._bar.update(done / 1e6, size / 1e6)


@contextlib.contextmanager
def learning(source: FrameSource, max_iterations: int | None) -> Iterator[tuple[Stop, RunProgress]]:
    """Show the progress of a run while the body runs; the first signal asks it to stop."""
    with bar("learning", "blocks") as progress_bar, stoppable() as stop:
        yield stop, RunProgress(progress_bar, source.spec, max_iterations, source=source)
