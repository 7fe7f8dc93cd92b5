"""How results are printed, on stdout, and what the user should know, on stderr."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cdmisfa.core.errors import UsageError

if TYPE_CHECKING:
    from cdmisfa.core.blocks import FrameSource

SCHEMA = 1
"""Version of the JSON documents; rises when a key changes its meaning or goes away."""


def quoted(path: str | Path) -> str:
    """A path as a shell takes it in a command to copy."""
    return shlex.quote(str(path))


def print_json(document: Mapping[str, Any]) -> None:
    """One JSON document on stdout; see `plain`."""
    from cdmisfa.experiments.documents import plain

    click.echo(json.dumps(plain(document), allow_nan=False))


def print_document(**each: Any) -> None:
    """One JSON document of these keys on stdout, with `SCHEMA`."""
    print_json({"schema": SCHEMA, **each})


def print_table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Rows of cells in aligned columns under a ruled head, on stdout."""
    cells = [[str(cell) for cell in row] for row in (head, *rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(head))]
    cells.insert(1, ["-" * width for width in widths])
    for row in cells:
        click.echo("  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip())


def say_failed(rows: Sequence[Mapping[str, Any]], *, err: bool = False) -> None:
    """Say which trials failed."""
    for row in rows:
        at = " ".join(f"{key}={value}" for key, value in row["point"].items())
        click.echo(f"failed: {at} seed {row['seed']}: {row['error']}", err=err)


def tell(line: str) -> None:
    """A line on stderr."""
    click.echo(line, err=True)


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
    for name, shape in getattr(source, "shapes", {}).items():
        if "," in shape:  # not the image itself
            tell(f"{name}: {shape}")
    what = "images" if source.spec.images else "messages"
    for name, counts in getattr(source, "alignment", {}).items():
        tell(
            f"{name}: {counts['messages']} {what}, "
            f"{counts['repeated']} frames repeated, {counts['dropped']} {what} dropped"
        )


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
    click.echo(f"{source.frames} frames at {source.spec.fps:g} a second, {seconds:.6g} s")
    unknown = [row["stream"] for row in rows if row["size_changes"] is None]
    if unknown:
        said = "whether images change their size shows when they are read"
        click.echo(f"{said}: {' '.join(unknown)}")
    for warning in warnings:
        warn(warning)
