"""Print results to stdout; print messages and warnings to stderr."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cdmisfa.core.untrusted import printable

if TYPE_CHECKING:
    from cdmisfa.core.blocks import FrameSource
    from cdmisfa.experiments.run_folder import RunResult
    from replay.integrity.report import ModuleInfo

# Version of the JSON documents; rises when a key changes its meaning or goes away.
SCHEMA = 1


class Stderr:
    """State of standard error: `quiet` is true with -q, which suppresses all but errors."""

    quiet = False


def quoted(path: str | Path) -> str:
    """Return a path as a shell takes it, for a command to copy."""
    return shlex.quote(str(path))


def _safe(value: object) -> str:
    """Return a text that cannot steer the terminal, with URLs in place of their local copies."""
    from replay.storage.location import with_urls

    return printable(with_urls(str(value)))


def line(text: object = "", *, err: bool = False) -> None:
    """Print a line to stdout, or to stderr even with -q."""
    click.echo(_safe(text), err=err)


def text(content: str) -> None:
    """Print several lines to stdout."""
    for each_line in content.removesuffix("\n").split("\n"):
        line(each_line)


def status(text: str) -> None:
    """Print a message to stderr, unless -q is given."""
    if not Stderr.quiet:
        line(text, err=True)


def warning(text: str) -> None:
    """Print a warning to stderr, unless -q is given."""
    status(f"warning: {text}")


def json_document(document: Mapping[str, Any]) -> None:
    """Print a JSON document to stdout."""
    from cdmisfa.experiments.documents import plain

    line(json.dumps(plain(document), allow_nan=False))


def document(**values: Any) -> None:
    """Print a JSON document with these keys and `SCHEMA` to stdout."""
    json_document({"schema": SCHEMA, **values})


def table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Print a table to stdout: wrapped to fit a terminal, else with one line for each row."""
    cells = [[_safe(cell) for cell in row] for row in (head, *rows)]
    if sys.stdout.isatty():
        from rich.console import Console  # takes a tenth of a second
        from rich.table import Table
        from rich.text import Text

        grid = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="")
        for name in cells[0]:
            grid.add_column(Text(name), overflow="fold")
        for row in cells[1:]:
            grid.add_row(*map(Text, row))
        Console().print(grid)
        return
    from rich.cells import cell_len  # wide letters take two columns, accents none

    widths = [max(map(cell_len, column)) for column in zip(*cells, strict=True)]
    cells.insert(1, ["-" * width for width in widths])
    for row in cells:
        padded = (c + " " * (w - cell_len(c)) for c, w in zip(row, widths, strict=True))
        line("  ".join(padded).rstrip())


# Sources


def source(frames: FrameSource) -> None:
    """Print warnings about a source, how its images become frames, and how its streams align."""
    from cdmisfa.experiments.documents import notes_of

    for text in getattr(frames, "warnings", ()):
        warning(text)
    for note in notes_of(frames):
        status(note)
    unit = _unit(frames)
    for name, counts in getattr(frames, "alignment", {}).items():
        status(
            f"{name}: {counts['messages']} {unit}, {counts['repeated']} frames repeated, "
            f"{counts['dropped']} {unit} dropped"
        )


def source_changes(frames: FrameSource) -> None:
    """Print damage that showed while a log was read, or the counts of live streams."""
    from cdmisfa.experiments.documents import warnings_of

    if not hasattr(frames, "stop"):
        for text in warnings_of(frames)[len(getattr(frames, "warnings", ())) :]:
            warning(text)
        return
    unit = _unit(frames)
    for name, counts in getattr(frames, "alignment", {}).items():
        status(
            f"{name}: {counts['messages']} {unit}; frames: {counts['repeated']} repeated, "
            f"{counts['missing']} missing; {unit}: {counts['dropped']} between frames, "
            f"{counts['late']} late, {counts['disordered']} out of order, {counts['lost']} lost"
        )


def _unit(frames: FrameSource) -> str:
    images = all(dtype == "uint8" for _, dtype in frames.spec.every_kind)
    return "images" if images else "messages"


# Results of runs


def result(run: RunResult, about: Mapping[str, Any] | None) -> None:
    """Print the result of a run that has ended: as JSON with keys about its source, if given."""
    from cdmisfa.core.names import counted
    from cdmisfa.core.outcomes import END_REASONS
    from replay.integrity.report import ModuleInfo

    if about is not None:
        json_document({**run.as_json(), **about})
        return
    streams = run.summary.get("streams")
    modules([ModuleInfo.of(m) for m in run.modules], policies=streams is None)
    for stream in streams or ():
        stream_outcome(stream)
    if streams is None and run.undecided:
        line(f"not decided: {', '.join(run.undecided)}")
    if run.held_out:
        holdout_slowness(run.held_out)
    passes = f" and {run.passes} passes over the log" if (run.passes or 1) > 1 else ""
    line(f"ended after {counted(run.iterations, 'iteration')}{passes}: {END_REASONS[run.ended]}")
    line(f"signals sha256 {run.signals_sha256}")
    if run.run is not None:
        line(f"run written to {run.run}; view it with cdmisfa view {quoted(run.run)}")


def modules(learned: Sequence[ModuleInfo], *, policies: bool) -> None:
    """Print a table of modules, on request with the policies that led to them."""
    from cdmisfa.core.signals import ACTIONS

    if not learned:
        line("no module was learned")
        return
    head = ["module", "stream", "iteration", "slowness"]
    rows: list[list[Any]] = [[m.index, m.stream, m.iteration, _outputs(m)] for m in learned]
    if policies:
        head.insert(3, "policy")
        for row, module in zip(rows, learned, strict=True):
            row.insert(3, " ".join(ACTIONS[action] for action in module.policy))
    table(head, rows)
    if any("(" in row[-1] for row in rows):
        line("in brackets: not slow on new frames")


def _outputs(module: ModuleInfo) -> str:
    """Return the slowness of each slow output, and the number of the principal ones."""
    slow = module.kinds.count("slow")
    texts = [slownesses(module.slowness[:slow], module.slow[:slow])]
    texts += [f"{module.kinds.count('principal')} principal"] * ("principal" in module.kinds)
    return "; ".join(texts)


def slownesses(eta: Sequence[float], slow: Sequence[int] = ()) -> str:
    """Return the slowness of each output as text; in brackets if the output is not slow."""
    texts = [f"{value:.4f}" for value in eta]
    for i, is_slow in enumerate(slow):
        texts[i] = texts[i] if is_slow else f"({texts[i]})"
    return ", ".join(texts)


def stream_outcome(stream: Mapping[str, Any]) -> None:
    """Print what the progress learner decided about a stream."""
    from cdmisfa.core.outcomes import outcome_text

    values = (stream[key] for key in ("state", "module", "blocks", "slowness", "why"))
    line(f"{stream['stream']}: {outcome_text(*values)}")


def holdout_slowness(result: Mapping[str, Any]) -> None:
    """Print the slowness of modules on held-out frames, beside that of batch SFA."""
    if not result["modules"]:
        return
    start, stop = result["frames"]
    line(f"slowness on the held-out frames {start} to {stop - 1}:")
    for module in result["modules"]:
        online, batch = (slownesses(module[key]) for key in ("slowness", "of_batch"))
        line(f"module {module['module']} of {module['stream']}: {online}; batch SFA: {batch}")
