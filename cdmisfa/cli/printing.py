"""What is printed: results on stdout; progress, and what the user should know, on stderr."""

from __future__ import annotations

import contextlib
import json
import shlex
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cdmisfa.cli.interrupts import stoppable
from cdmisfa.core.errors import UsageError
from cdmisfa.core.learning import Sink
from cdmisfa.core.untrusted import printable

if TYPE_CHECKING:
    from cdmisfa.cli.interrupts import Stop
    from cdmisfa.core.blocks import Block, FrameSource
    from cdmisfa.core.learning import Learner
    from cdmisfa.core.signals import BlockSignals
    from cdmisfa.experiments.run_folder import RunResult
    from replay.viewer.broadcast import Broadcast

SCHEMA = 1
"""Version of the JSON documents; rises when a key changes its meaning or goes away."""


MEGABYTE, GIGABYTE = 10**6, 10**9

TICK = 0.1
"""Seconds between two updates of the bar: a block may take only microseconds."""


def quoted(path: str | Path) -> str:
    """A path as a shell takes it in a command to copy."""
    return shlex.quote(str(path))


def print_line(line: object = "", *, err: bool = False) -> None:
    """A line on stdout, or stderr; names in it cannot steer the terminal."""
    click.echo(printable(str(line)), err=err)


def print_text(text: str) -> None:
    """Several lines on stdout."""
    for line in text.removesuffix("\n").split("\n"):
        print_line(line)


def print_json(document: Mapping[str, Any]) -> None:
    """One JSON document on stdout; see `plain`."""
    from cdmisfa.experiments.documents import plain

    print_line(json.dumps(plain(document), allow_nan=False))


def print_document(**each: Any) -> None:
    """One JSON document of these keys on stdout, with `SCHEMA`."""
    print_json({"schema": SCHEMA, **each})


def print_table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Rows of cells in aligned columns under a ruled head, on stdout."""
    cells = [[printable(str(cell)) for cell in row] for row in (head, *rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(head))]
    cells.insert(1, ["-" * width for width in widths])
    for row in cells:
        print_line("  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip())


def say_failed(rows: Sequence[Mapping[str, Any]], *, err: bool = False) -> None:
    """Say which trials failed."""
    for row in rows:
        at = " ".join(f"{key}={value}" for key, value in row["point"].items())
        print_line(f"failed: {at} seed {row['seed']}: {row['error']}", err=err)


def tell(line: str) -> None:
    """A line on stderr."""
    print_line(line, err=True)


def warn(line: str) -> None:
    """A warning on stderr."""
    tell(f"warning: {line}")


def say_counts(source: FrameSource) -> None:
    """Say on stderr what became of each live stream's pictures, or messages with numbers."""
    what = "pictures" if source.spec.images else "messages"
    for name, counts in getattr(source, "alignment", {}).items():
        tell(
            f"{name}: {counts['messages']} {what}; {counts['repeated']} frames repeated, "
            f"{counts['missing']} missing; {what}: {counts['dropped']} between frames, "
            f"{counts['late']} late, {counts['disordered']} out of order, {counts['lost']} thrown "
            "away"
        )


def say_about(source: FrameSource) -> None:
    """Say on stderr what the user should know of a source, and how images became frames."""
    for warning in getattr(source, "warnings", ()):
        warn(warning)
    for note in getattr(source, "notes", ()):
        tell(note)
    for name, shape in getattr(source, "shapes", {}).items():
        if "," in shape:  # not the image itself
            tell(f"{name}: {shape}")
    what = "images" if source.spec.images else "messages"
    for name, counts in getattr(source, "alignment", {}).items():
        tell(
            f"{name}: {counts['messages']} {what}, "
            f"{counts['repeated']} frames repeated, {counts['dropped']} {what} dropped"
        )


def refuse_copies(source: FrameSource, *, strict: bool) -> None:
    """Refuse logs of which one shows the same as another, where that is asked for.

    Raises:
        UsageError: one does.
    """
    if strict and (said := getattr(source, "copies", ())):
        raise UsageError(f"{said[0]}: leave one out, or leave out --strict")


def say_changes(source: FrameSource) -> None:
    """Say on stderr what showed while a source was read: changes of size, broken images."""
    changes = getattr(source, "changes", {}).values()  # only logs of others have these
    for line in (*changes, *getattr(source, "salvaged", list)()):
        warn(line)


def print_plan(source: FrameSource, *, as_json: bool) -> None:
    """Print what would be read: streams, sizes, rates, gaps and drops.

    Raises:
        UsageError: it is no camera log.
    """
    from replay.camera_logs.source import ForeignSource

    if not isinstance(source, ForeignSource):
        raise UsageError("--dry-run is for camera logs: cdmisfa info says what is in a recording")
    rows = source.plan()
    warnings = [*source.warnings, *source.changes.values()]
    if as_json:
        size = list(source.spec.frame_shape)
        plan = {"frames": source.frames, "rate": source.spec.fps, "size": size, "streams": rows}
        print_document(**plan, warnings=warnings)
        return
    what = "images" if source.spec.images else "messages"
    head = ("stream", what, "rate", "size", "missing", "gaps", "repeated", "dropped")
    cells = [
        (row["stream"], row["images"], "-" if row["rate"] is None else f"{row['rate']:.6g}",
         row["shape"], row["missing"], len(row["gaps"]), row["repeated"], row["dropped"])
        for row in rows
    ]  # fmt: skip
    print_table(head, cells)
    seconds = source.frames / source.spec.fps
    print_line(f"{source.frames} frames at {source.spec.fps:g} a second, {seconds:.6g} s")
    unknown = [row["stream"] for row in rows if row["size_changes"] is None]
    if unknown:
        said = "whether images change their size shows when they are read"
        print_line(f"{said}: {' '.join(unknown)}")
    for note in source.notes:
        tell(note)
    for warning in warnings:
        warn(warning)


def announce(broadcast: Broadcast) -> None:
    """Say where a live view is, and open it where there is a display."""
    from replay.viewer.program import has_display

    tell(f"live view {broadcast.address}    look at it in a browser of this machine")
    if has_display():
        broadcast.open_window()


def outcome_line(outcome: Mapping[str, Any]) -> str:
    """What became of a stream, in words."""
    came = "not decided" if outcome["state"] == "learning" else outcome["state"].replace("_", " ")
    if outcome["module"] is not None:
        came += f" by module {outcome['module']}"
    if outcome["slowness"] is not None:
        came += f", slowness {outcome['slowness']:.4f} on frames not learned from"
    because = f": {outcome['why']}" if outcome["why"] else ""
    after = f"{outcome['blocks']} block{'' if outcome['blocks'] == 1 else 's'}"
    return f"{outcome['stream']}: {came}, after {after}{because}"


BRACKETS = "in brackets: not slow on frames that were not learned from"


def slownesses(eta: Sequence[float], slow: Sequence[int]) -> str:
    """The slowness of each output; in brackets that of those known not to be slow."""
    marks = slow if len(slow) else [1] * len(eta)
    return ", ".join(
        f"{value:.4f}" if mark else f"({value:.4f})" for value, mark in zip(eta, marks, strict=True)
    )


def print_held_out(found: Mapping[str, Any]) -> None:
    """Print how slow modules are on frames that were held out, beside batch SFA."""
    start, stop = found["frames"]
    print_line(f"slowness on the frames {start} to {stop - 1}, which were held out:")
    for one in found["modules"]:
        own, batch = (slownesses(one[key], ()) for key in ("slowness", "of_batch"))
        print_line(f"module {one['module']} of {one['stream']}: {own}; batch SFA: {batch}")


def print_result(result: RunResult, *, as_json: bool) -> None:
    """Print what a run came to."""
    from cdmisfa.core.signals import ACTIONS
    from cdmisfa.experiments.loop import ENDINGS

    if as_json:
        print_json(result.as_json())
        return
    rows = [
        (
            module.index,
            module.stream,
            module.iteration,
            " ".join(ACTIONS[action] for action in module.policy),
            slownesses(module.eta.tolist(), module.slow.tolist()),
        )
        for module in result.modules
    ]
    if rows and "streams" not in result.summary:
        print_table(("module", "stream", "iteration", "policy", "eta"), rows)
    elif rows:  # no policy led to them
        without = [(index, stream, iteration, eta) for index, stream, iteration, _, eta in rows]
        print_table(("module", "stream", "iteration", "eta"), without)
    else:
        print_line("no module was learned")
    if any(0 in module.slow for module in result.modules):
        print_line(BRACKETS)
    if "streams" in result.summary:
        for outcome in result.summary["streams"]:
            print_line(outcome_line(outcome))
    elif result.undecided:
        print_line(f"not decided: {', '.join(result.undecided)}")
    if result.held_out and result.modules:
        print_held_out(result.held_out)
    print_line(f"ended after {result.iterations} iterations: {ENDINGS[result.ended]}")
    print_line(f"signals sha256 {result.signals_sha256}")
    if result.run is not None:
        look = f"look at it: cdmisfa view {quoted(result.run)}"
        print_line(f"run {result.run}    {look}")


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
            progress.console.print(printable(line), markup=False, highlight=False, emoji=False)

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

    def event(self, t: int, iteration: int, text: str, level: str = "INFO") -> None:
        """See `Sink`."""
        if level == "WARNING":
            self._shown.say(text)

    def hashing(self, done: int, size: int) -> None:
        """Show how far the source's files are hashed, once that is waited for."""
        if not self._hashing:
            self._hashing = True
            self._shown.turn_to("hashing", "MB")
            read = f"{done / GIGABYTE:.1f} of {size / GIGABYTE:.1f} GB are read"
            self._shown.say(f"waiting for the SHA-256 of what is learned from: {read}")
        self._shown.update(done / MEGABYTE, size / MEGABYTE)


@contextlib.contextmanager
def learning(max_iterations: int | None) -> Iterator[tuple[Stop, Reporter]]:
    """Show the progress of a run, and end it at a signal."""
    with bar("learning", "blocks") as shown, stoppable() as stop:
        yield stop, Reporter(shown, max_iterations)
