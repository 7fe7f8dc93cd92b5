"""What is printed: results on stdout; progress, and what the user should know, on stderr."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cdmisfa.core.names import counted
from cdmisfa.core.untrusted import printable
from replay.storage.location import with_urls

if TYPE_CHECKING:
    from cdmisfa.core.blocks import FrameSource
    from cdmisfa.experiments.run_folder import RunResult
    from replay.integrity.learned import ModuleInfo

SCHEMA = 1
"""Version of the JSON documents; rises when a key changes its meaning or goes away."""


def quoted(path: str | Path) -> str:
    """A path as a shell takes it in a command to copy."""
    return shlex.quote(str(path))


def print_line(line: object = "", *, err: bool = False) -> None:
    """A line on stdout, or stderr; names in it cannot steer the terminal."""
    click.echo(printable(with_urls(str(line))), err=err)


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
    """Print rows of cells in columns below a head, on stdout.

    A terminal gets a table that fits, with long cells broken; other programs get a line a row.
    """
    cells = [[printable(with_urls(str(cell))) for cell in row] for row in (head, *rows)]
    if sys.stdout.isatty():
        from rich.console import Console  # takes a tenth of a second
        from rich.table import Table
        from rich.text import Text

        table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="")
        for name in cells[0]:
            table.add_column(Text(name), overflow="fold")
        for row in cells[1:]:
            table.add_row(*map(Text, row))
        Console().print(table)
        return
    from rich.cells import cell_len  # wide letters take two places, accents none

    widths = [max(map(cell_len, column)) for column in zip(*cells, strict=True)]
    cells.insert(1, ["-" * width for width in widths])
    for row in cells:
        filled = (c + " " * (w - cell_len(c)) for c, w in zip(row, widths, strict=True))
        print_line("  ".join(filled).rstrip())


def print_columns(columns: Mapping[str, Sequence[Any]]) -> None:
    """Columns below their names, as `print_table` does."""
    print_table(list(columns), list(zip(*columns.values(), strict=True)))


def say_failed(rows: Sequence[Mapping[str, Any]], *, err: bool = False) -> None:
    """Say which trials failed."""
    for row in rows:
        at = " ".join(f"{key}={value}" for key, value in row["point"].items())
        print_line(f"failed: {at} seed {row['seed']}: {row['error']}", err=err)


class Stderr:
    """Standard error.

    Attributes:
        quiet: whether the command prints nothing there but errors (-q).
    """

    quiet = False


def tell(line: str) -> None:
    """Print a line on stderr, unless that is to be quiet."""
    if not Stderr.quiet:
        print_line(line, err=True)


def warn(line: str) -> None:
    """A warning on stderr."""
    tell(f"warning: {line}")


def say_counts(source: FrameSource) -> None:
    """Say on stderr what became of each live stream's pictures, or messages with numbers."""
    what = "pictures" if source.spec.images else "messages"
    for name, counts in getattr(source, "alignment", {}).items():
        tell(
            f"{name}: {counts['messages']} {what}; "
            f"{counted(counts['repeated'], 'frame')} repeated, {counts['missing']} missing; "
            f"{what}: {counts['dropped']} between frames, "
            f"{counts['late']} late, {counts['disordered']} out of order, {counts['lost']} thrown "
            "away"
        )


def say_about(source: FrameSource) -> None:
    """Say on stderr what the user should know of a source, and how images became frames."""
    for warning in getattr(source, "warnings", ()):
        warn(warning)
    for note in getattr(source, "notes", ()):
        tell(note)
    for name, framing in zip(source.spec.streams, getattr(source, "framings", ()), strict=False):
        if "," in str(framing):  # not the image itself
            tell(f"{name}: {framing}")
    what = "images" if source.spec.images else "messages"
    for name, counts in getattr(source, "alignment", {}).items():
        tell(
            f"{name}: {counts['messages']} {what}, "
            f"{counted(counts['repeated'], 'frame')} repeated, {counts['dropped']} {what} dropped"
        )


def say_changes(source: FrameSource) -> None:
    """Say on stderr what showed while a source was read: changes of size, broken images."""
    changes = getattr(source, "changes", {}).values()  # only logs of others have these
    for line in (*changes, *getattr(source, "salvaged", list)()):
        warn(line)


def outcome_line(outcome: Mapping[str, Any]) -> str:
    """What became of a stream, in words."""
    came = "not decided" if outcome["state"] == "learning" else outcome["state"].replace("_", " ")
    if outcome["module"] is not None:
        came += f" by module {outcome['module']}"
    if outcome["slowness"] is not None:
        came += f", slowness {outcome['slowness']:.4f} on frames not learned from"
    because = f": {outcome['why']}" if outcome["why"] else ""
    after = counted(outcome["blocks"], "block")
    return f"{outcome['stream']}: {came}, after {after}{because}"


def print_modules(modules: Sequence[ModuleInfo], *, policies: bool) -> None:
    """Print a table of modules, with the policies that led to them where there are some."""
    from cdmisfa.core.signals import ACTIONS

    if not modules:
        print_line("no module was learned")
        return
    columns: dict[str, list[object]] = {
        "module": [m.index for m in modules],
        "stream": [m.stream for m in modules],
        "iteration": [m.iteration for m in modules],
        "policy": [" ".join(ACTIONS[action] for action in m.policy) for m in modules],
        "slowness": [slownesses(m.slowness, m.slow) for m in modules],
    }
    if not policies:
        del columns["policy"]
    print_columns(columns)
    if any(0 in m.slow for m in modules):
        print_line("in brackets: not slow on frames that were not learned from")


def slownesses(eta: Sequence[float], slow: Sequence[int]) -> str:
    """The slowness of each output; in brackets that of those known not to be slow."""
    marks = slow if len(slow) else [1] * len(eta)
    return ", ".join(
        f"{value:.4f}" if mark else f"({value:.4f})" for value, mark in zip(eta, marks, strict=True)
    )


def print_held_out(found: Mapping[str, Any]) -> None:
    """Print how slow modules are on frames that were held out, beside batch SFA."""
    if not found["modules"]:
        return
    start, stop = found["frames"]
    print_line(f"slowness on the frames {start} to {stop - 1}, which were held out:")
    for one in found["modules"]:
        own, batch = (slownesses(one[key], ()) for key in ("slowness", "of_batch"))
        print_line(f"module {one['module']} of {one['stream']}: {own}; batch SFA: {batch}")


def print_result(result: RunResult, *, as_json: bool) -> None:
    """Print what a run came to."""
    from cdmisfa.experiments.loop import ENDINGS
    from replay.integrity.learned import ModuleInfo

    if as_json:
        print_json(result.as_json())
        return
    modules = [ModuleInfo.of(module) for module in result.modules]
    print_modules(modules, policies="streams" not in result.summary)
    if "streams" in result.summary:
        for outcome in result.summary["streams"]:
            print_line(outcome_line(outcome))
    elif result.undecided:
        print_line(f"not decided: {', '.join(result.undecided)}")
    if result.held_out:
        print_held_out(result.held_out)
    print_line(f"ended after {counted(result.iterations, 'iteration')}: {ENDINGS[result.ended]}")
    print_line(f"signals sha256 {result.signals_sha256}")
    if result.run is not None:
        look = f"look at it: cdmisfa view {quoted(result.run)}"
        print_line(f"run {result.run}    {look}")
