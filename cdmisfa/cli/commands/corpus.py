"""`cdmisfa index`: one table of what is in many logs."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import click

from cdmisfa.cli import options
from cdmisfa.cli.commands.info import in_bytes
from cdmisfa.cli.interrupts import stoppable
from cdmisfa.cli.printing import (
    print_document,
    print_line,
    print_table,
    tell,
    warn,
)
from cdmisfa.cli.progress import bar
from cdmisfa.core.names import counted, lasting

if TYPE_CHECKING:
    from replay.corpus.index import Indexed

MOST_GONE = 5
"""Logs that are gone, of which so many are named."""

JOBS = click.option(
    "--jobs",
    type=click.IntRange(1, 1024),
    help="Parallel processes; by default as many as there are processors.",
)


@click.command("index")
@click.argument("corpus", nargs=-1, required=True, type=options.WORD)
@options.out("The index, a .parquet file; by default corpus.parquet in the folder.")
@click.option(
    "--deep",
    is_flag=True,
    help="Decode every log: damage that no summary shows, gaps, shapes.",
)
@JOBS
@options.as_json
@options.quiet
@click.pass_context
def index_command(
    ctx: click.Context,
    corpus: tuple[str, ...],
    out: Path | None,
    deep: bool,
    jobs: int | None,
    as_json: bool,
) -> None:
    """Index what is in many logs: streams, times, damage.

    CORPUS is a folder, with all that is in it, a pattern such as 'logs/**/*.mcap', or
    several: recordings, runs, logs of others. The index is one Parquet file, a row a stream; a
    log that cannot be read is a row with its problem. Run again, it reads what is new or changed.
    """
    from replay.corpus.index import index_logs

    with bar("indexing", "logs") as shown, stoppable() as stop:
        made = index_logs(
            corpus,
            out,
            deep=deep,
            jobs=jobs or os.cpu_count() or 1,
            told=shown.update,
            stop=stop,
        )
    if made.anew:
        warn(made.anew)
    if as_json:
        told = {name: getattr(made, name) for name in ("logs", "streams", "read", "kept", "gone")}
        told |= {"broken": made.broken, "kinds": made.kinds, "problems": made.problems}
        print_document(index=made.index, **told, complete=not made.stopped)
    else:
        said = f"{counted(made.logs, 'log')}, {counted(made.streams, 'stream')}: {made.read} read"
        print_line(
            f"{said}, {made.kept} as before, {len(made.gone)} gone, {made.broken} with a problem"
        )
        for path in made.gone[:MOST_GONE]:
            print_line(f"gone: {path}")
        if (more := len(made.gone) - MOST_GONE) > 0:
            print_line(f"gone: {more} more")
        _print_summary(made)
        print_line(f"written {made.index}")
    if made.stopped:
        tell("stopped before all were read: the same command goes on")
        ctx.exit(stop.exit_code)


def _print_summary(made: Indexed) -> None:
    """Print how much the index has of each kind of log, and which logs have a problem."""
    cells = [
        (row["kind"], row["logs"], row["files"], row["streams"], lasting(row["seconds"]),
         in_bytes(row["bytes"]))
        for row in made.kinds
    ]  # fmt: skip
    if cells:
        print_table(("kind", "logs", "files", "streams", "length", "size"), cells)
    for row in made.problems:
        print_line(f"{row['path']}: {row['problem']}")
    if (more := made.broken - len(made.problems)) > 0:
        print_line(f"and {more} more logs with a problem")
