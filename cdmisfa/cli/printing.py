"""What is printed: results on stdout; progress, and what the user should know, on stderr."""

from __future__ import annotations

import itertools
import json
import shlex
import shutil
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


NARROWEST = 8
"""Letters of a column in which words are broken, or fewer where it needs no more."""


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
    """Rows of cells in aligned columns under a ruled head, on stdout; it fits into a terminal.

    Where it does not, its widest cells go on in the next lines. What no terminal shows has a line
    a row, for other programs.
    """
    from rich.cells import cell_len

    cells = [[printable(with_urls(str(cell))) for cell in row] for row in (head, *rows)]
    columns = list(zip(*cells, strict=True))
    widths = [max(map(cell_len, column)) for column in columns]
    if sys.stdout.isatty():
        words = [
            max(cell_len(word) for cell in column for word in cell.split(" ")) for column in columns
        ]
        room = shutil.get_terminal_size().columns
        widths = fitting(fitting(widths, words, room), [NARROWEST] * len(widths), room)
    cells.insert(1, ["-" * width for width in widths])
    for row in cells:
        parts = [_wrapped(c, w) for c, w in zip(row, widths, strict=True)]
        for line in itertools.zip_longest(*parts, fillvalue=""):
            filled = (c + " " * (w - cell_len(c)) for c, w in zip(line, widths, strict=True))
            print_line("  ".join(filled).rstrip())


def _wrapped(text: str, width: int) -> list[str]:
    """Lines of a text, of so many places of a terminal: wide letters take two, accents none."""
    from rich.cells import cell_len

    if cell_len(text) <= width:
        return [text]
    from rich.console import Console
    from rich.text import Text

    lines = Text(text).wrap(Console(width=width), width)
    return [line.plain.rstrip() for line in lines]


def print_columns(columns: Mapping[str, Sequence[Any]]) -> None:
    """Columns below their names, as `print_table` does."""
    print_table(list(columns), list(zip(*columns.values(), strict=True)))


def fitting(widths: Sequence[int], least: Sequence[int], room: int) -> list[int]:
    """Widths of columns, two spaces apart, of which the widest are narrowed until all fit.

    Args:
        widths: that they would like to have.
        least: that they keep, even where they do not fit.
        room: for all of them.
    """
    fit = list(widths)
    while sum(fit) + 2 * (len(fit) - 1) > room:
        spare = [width if width > keeps else 0 for width, keeps in zip(fit, least, strict=True)]
        if not any(spare):
            break
        fit[spare.index(max(spare))] -= 1
    return fit


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
