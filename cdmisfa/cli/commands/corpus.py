"""Commands on many logs: their index, and questions to it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cdmisfa.cli import options
from cdmisfa.cli.commands.info import in_bytes
from cdmisfa.cli.interrupts import stoppable
from cdmisfa.cli.making import flag, number
from cdmisfa.cli.printing import (
    print_columns,
    print_document,
    print_line,
    print_table,
    quoted,
    tell,
    warn,
)
from cdmisfa.cli.progress import bar
from cdmisfa.core.names import counted, lasting

if TYPE_CHECKING:
    from replay.corpus.query import Summary

MOST_GONE = 5
"""Logs that are gone, of which so many are named."""

JOBS = number("--jobs", "Parallel processes; by default as many as there are processors.", 1, 1024)


@click.command("index")
@click.argument("corpus", nargs=-1, required=True, type=options.WORD)
@options.out("The index, a .parquet file; by default corpus.parquet in the folder.")
@flag("--deep", "Decode every log: checksums, gaps, shapes, and what is twice in other files.")
@flag("--full", "Read every byte: what changed shows by SHA-256, not by size and time.")
@JOBS
@options.as_json
@options.quiet
@click.pass_context
def index_command(
    ctx: click.Context,
    corpus: tuple[str, ...],
    out: Path | None,
    deep: bool,
    full: bool,
    jobs: int | None,
    as_json: bool,
) -> None:
    """Index what is in many logs: streams, times, damage, doubles.

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
            full=full,
            jobs=jobs or os.cpu_count() or 1,
            told=shown.update,
            stop=stop,
        )
    if made.anew:
        warn(made.anew)
    if as_json:
        told = {name: getattr(made, name) for name in ("logs", "streams", "read", "kept", "gone")}
        print_document(index=made.index, **told, broken=made.broken, complete=not made.stopped)
    else:
        said = f"{counted(made.logs, 'log')}, {counted(made.streams, 'stream')}: {made.read} read"
        print_line(
            f"{said}, {made.kept} as before, {len(made.gone)} gone, {made.broken} with a problem"
        )
        for path in made.gone[:MOST_GONE]:
            print_line(f"gone: {path}")
        if (more := len(made.gone) - MOST_GONE) > 0:
            print_line(f"gone: {more} more")
        print_line(f"written {made.index}")
    if made.stopped:
        tell("stopped before all were read: the same command goes on")
        ctx.exit(stop.exit_code)
    tell(f"look at it: cdmisfa query {quoted(_named(made.index))}")


def _named(index: Path) -> Path:
    """An index as `query` takes it: a folder by itself."""
    from replay.corpus.finding import INDEX

    return index.parent if index.name == INDEX else index


@click.command("query")
@click.argument("corpus", type=options.WORD)
@click.argument("sql", required=False)
@options.out("Write the answer as a .parquet file.")
@options.force
@options.as_json
def query_command(
    corpus: str, sql: str | None, out: Path | None, force: bool, as_json: bool
) -> None:
    """Ask an index in SQL, or say what it has: how much, broken, double.

    CORPUS is a folder that cdmisfa index indexed, or an index. The tables are streams (a row each),
    logs (a row a file) and doubles (a row for files that hold the same). A query sees these alone:
    it reads and writes no other file.
    """
    from replay.corpus.index import index_path
    from replay.corpus.query import ask, summary, write_answer

    index = index_path(corpus)
    if sql is None and out is None:
        found = summary(index)
        if as_json:
            print_document(index=index, **found.as_json())
        else:
            _print_summary(found)
        return
    answer = ask(index, sql or "SELECT * FROM streams")
    if out is not None:
        write_answer(answer, out, force=force)
    if as_json:
        rows = [] if out is not None else [_plain(row) for row in answer.to_pylist()]
        print_document(columns=answer.column_names, rows=rows, file=out)
    elif out is not None:
        print_line(f"{counted(answer.num_rows, 'row')} written to {out}")
    elif answer.num_columns:
        cells = [["" if v is None else v for v in row.values()] for row in answer.to_pylist()]
        print_table(answer.column_names, cells)


def _plain(value: Any) -> Any:
    """A value of an answer as JSON has it; times and other types as texts."""
    if isinstance(value, dict):
        return {str(name): _plain(each) for name, each in value.items()}
    if isinstance(value, list):
        return [_plain(each) for each in value]
    return value if isinstance(value, str | int | float | bool | None) else str(value)


def _print_summary(found: Summary) -> None:
    """Print how much there is of what, what is broken, and what is double."""
    columns = ("kind", "logs", "files", "streams")
    print_columns(
        {name: [row[name] for row in found.kinds] for name in columns}
        | {
            "length": [lasting(row["seconds"]) for row in found.kinds],
            "size": [in_bytes(row["bytes"]) for row in found.kinds],
        }
    )
    print_line()
    cells = [
        (row["topic"], row["schema"], row["shape"] or "-", row["streams"], row["messages"],
         "-" if row["rate"] is None else f"{row['rate']:.4g}", lasting(row["seconds"]),
         "-" if row["gaps"] is None else row["gaps"])
        for row in found.streams
    ]  # fmt: skip
    head = ("topic", "schema", "shape", "streams", "messages", "Hz", "length", "missing")
    print_table(head, cells)
    _say_more(found, "streams", "kinds of streams")
    print_line()
    print_line(f"broken: {found.counts['broken']}")
    for row in found.broken:
        print_line(f"  {row['path']}: {row['problem']}")
    _say_more(found, "broken", "broken logs")
    print_line(f"double: {found.counts['double']}, {in_bytes(found.saved)} could be saved")
    for row in found.double:
        print_line(f"  {' = '.join(row['paths'])}: {in_bytes(row['bytes'])}")
    _say_more(found, "double", "doubles")


def _say_more(found: Summary, name: str, what: str) -> None:
    more = found.counts[name] - len(getattr(found, name))
    if more > 0:
        print_line(f"  and {more} more {what}: ask for them in SQL")
