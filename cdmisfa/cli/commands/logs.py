"""`cdmisfa info`, `verify`, `recover` and `index`: logs, recordings and runs as files."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cdmisfa.cli import options, printing
from cdmisfa.cli.progress import bar
from cdmisfa.core.errors import LogDamagedError
from cdmisfa.core.interrupts import stoppable
from cdmisfa.core.names import counted, duration_text

if TYPE_CHECKING:
    from replay.corpus.index import Indexed
    from replay.integrity.report import LogReport, SizeInfo

# Largest number of streams of a run that `info` names, to keep them on one line.
MOST_STREAMS = 8

# Words for kinds of logs, where they differ from the kinds that --json and the index have.
KIND_WORDS = {"foreign": "external log"}


@options.command("info")
@click.argument("path", nargs=-1, required=True, type=options.WORD)
@options.as_json
def info_command(path: tuple[str, ...], as_json: bool) -> int:
    """Show what a log, recording or run contains.

    The command prints topics, times and sizes, and for a run its modules and the result of each
    stream. For a folder it shows every log in it and below it, the duration of each and the sum.
    The exit code is 2 if a path is no log or a package that reads it is missing, and 3 if a log is
    damaged or cut short (3 wins). Contents that only cdmisfa verify reads are reported as not
    checked.

    PATH is one of:
        {run}
        {recording}
        {logs}
        {url}

    Examples:
        cdmisfa info left.mcap
        cdmisfa info 'logs/*.mcap'
        cdmisfa info runs/kitchen --json
    """
    from replay.integrity.info import describe
    from replay.integrity.report import EXIT_CODES

    info = describe(*path)
    if as_json:
        printing.json_document(info.as_json())
    else:
        _print_info(info)
    return EXIT_CODES[info.state]


def _print_info(info: LogReport) -> None:
    """Print the description of a log, a recording, a run, or several of them."""
    logs = info.logs()
    for part in [info] if len(logs) == 1 else logs:
        words: list[str] = [part.state]
        if part.state != "not read":
            state = part.state.replace("unchecked", "contents not checked")
            crc = f"checksums {part.crc}".replace("checksums absent", "no checksums")
            words = [KIND_WORDS.get(part.kind, part.kind), state, crc]
            words += [] if part.seed is None else [f"seed {part.seed}"]
        if len(logs) > 1 and part.seconds is not None:
            words.append(f"{part.seconds:.3f} s")
        printing.line(f"{part.path}: {', '.join(words)}")
    for line in (*(f"{p.where}: {p.what}" for p in info.problems), *info.notes):
        printing.line(line)
    if info.run is not None:
        _print_run(info, info.run)
    if len(logs) > 1:
        known = "" if info.seconds is None else f", {info.seconds:.3f} s in all"
        printing.line(f"{counted(len(logs), 'log')}, {counted(info.messages, 'message')}{known}")
    elif info.span is not None:
        printing.line(_length(info, *info.span))
    even = [log.path for log in logs if log.kind == "foreign" and log.channels and not log.span]
    if even:
        printing.line(
            f"{', '.join(even)}: no times: learn and convert need --rate, or for a table "
            "--set input.time=COLUMN"
        )
    if info.size.file:
        printing.line(", ".join(_storage(info.size, info.library)))
    _print_channels(logs)


def _print_run(info: LogReport, run: Mapping[str, Any]) -> None:
    """Print learner, modules, outcomes of streams and end of a run."""
    from cdmisfa.core.outcomes import END_REASONS

    streams = run["streams"]
    more = len(streams) - MOST_STREAMS
    names = ", ".join(streams[:MOST_STREAMS]) + (f" and {more} more" if more > 0 else "")
    printing.line(f"learner {run['algorithm']}, {counted(len(streams), 'stream')}: {names}")
    if info.modules or info.ended is not None:  # a run that has not ended has no module file yet
        printing.modules(info.modules, policies=not run["outcomes"])
    for outcome in run["outcomes"]:
        printing.stream_outcome(outcome)
    if info.held_out is not None:
        printing.holdout_slowness(info.held_out)
    done = f"{counted(run['iterations'], 'iteration')} of {counted(run['tau'], 'frame')}"
    if info.ended is None:
        printing.line(f"not finished after {done}: it is still learning, or was stopped")
    else:
        printing.line(f"ended after {done}: {END_REASONS.get(info.ended, info.ended)}")


def _length(info: LogReport, start: int, end: int) -> str:
    """Return the number of messages of a log, its duration, and its first and last time."""
    import numpy as np

    seconds = (end - start) / 1e9
    encodings = {channel.encoding for channel in info.channels}
    shared = f" ({encodings.pop()})" if len(encodings) == 1 else ""
    first, last = (f"{np.datetime64(ns // 10**6, 'ms')}Z".replace("T", " ") for ns in (start, end))
    times = "" if first.startswith("1970") else f", from {first} to {last}"  # a clock without date
    return f"{counted(info.messages, 'message')}{shared}, {seconds:.3f} s{times}"


def _storage(size: SizeInfo, library: str) -> Iterator[str]:
    """Yield the size of a log, its compression, and the library that wrote it."""
    from rich.filesize import decimal

    yield decimal(size.file)
    for name, count in sorted(size.compression.items()):
        yield counted(count, f"{name} chunk")
    if size.decompressed > size.stored:
        saved = 1 - size.stored / size.decompressed
        yield f"{decimal(size.decompressed)} decompressed ({saved:.0%} saved)"
    if library:
        yield f"written by {library}"


def _print_channels(logs: Sequence[LogReport]) -> None:
    """Print a table of channels; times are seconds since the first message of each log."""
    channels = [channel for log in logs for channel in log.channels]
    firsts = [log.span[0] if log.span else 0 for log in logs for _ in log.channels]

    def since(first: int, ns: int | None) -> str:
        return "-" if ns is None else f"{(ns - first) / 1e9:.3f}"

    columns: dict[str, list[object]] = {
        "topic": [c.topic for c in channels],
        "messages": [c.messages for c in channels],
        "Hz": ["-" if c.rate is None else f"{c.rate:.4g}" for c in channels],
        "from, s": [since(t, c.start_ns) for t, c in zip(firsts, channels, strict=True)],
        "to, s": [since(t, c.end_ns) for t, c in zip(firsts, channels, strict=True)],
        "encoding": [c.encoding for c in channels],
        "schema": [c.schema for c in channels],
        "file": [c.file for c in channels],
    }
    for name in ("encoding", "file"):  # values that all channels share are printed above
        if len(set(columns[name])) < 2:
            del columns[name]
    printing.table(list(columns), list(zip(*columns.values(), strict=True)))


@options.command("verify")
@click.argument("path", nargs=-1, required=True, type=options.WORD)
@options.as_json
def verify_command(path: tuple[str, ...], as_json: bool) -> int:
    """Verify that logs are complete and undamaged.

    The command reads every byte, compares checksums, and decodes every image of a log that has no
    checksums. The exit code is 2 if a path is no log or a package that reads it is missing, and 3
    if a log is damaged (3 wins).

    PATH is one of:
        {run}
        {recording}
        {logs}
        {url}

    Examples:
        cdmisfa verify left.mcap
        cdmisfa verify 'logs/**/*.mcap'
        cdmisfa verify runs/kitchen --json
    """
    from replay.integrity.report import EXIT_CODES
    from replay.integrity.verify import check_logs

    checked = check_logs(*path)
    if as_json:
        printing.json_document(checked.check_json())
    else:
        if checked.problems:
            printing.table(("where", "what"), [(p.where, p.what) for p in checked.problems])
        printing.line(f"{' '.join(path)}: {checked.state}")
        for note in checked.notes:
            printing.line(note)
    return EXIT_CODES[checked.state]


@options.command("recover")
@click.argument("path", type=options.WORD)
@options.output("New MCAP file or dataset to write.", required=True)
@options.force
@options.as_json
def recover_command(path: str, output: Path, force: bool, as_json: bool) -> int:
    """Repair a damaged MCAP file, or LeRobot dataset, into a new one.

    The command copies every message that can be read, and prints how many are lost. Of a LeRobot
    dataset whose recording was killed it copies the whole episodes, and writes tables, counts and
    statistics that match. The damaged log does not change. The exit code is 3 if something is lost.

    PATH is one of:
        left.mcap             an MCAP file, such as one of a recording, or run.mcap
        s3://lab/left.mcap    an MCAP file at an s3://, http:// or https:// address
        datasets/pick         a LeRobot dataset

    Examples:
        cdmisfa recover left.mcap -o left-repaired.mcap
        cdmisfa recover datasets/pick -o datasets/pick-whole
        cdmisfa recover https://example.org/left.mcap -o left.mcap --json
    """
    from replay.integrity.recover import recover_log

    recovery = recover_log(path, output, force=force)
    if as_json:
        printing.json_document(recovery.as_json())
    else:
        printing.table(
            ("topic", "saved", "lost"),
            [(c.topic, c.kept, "unknown" if c.lost is None else c.lost) for c in recovery.channels],
        )
        if recovery.lost:
            printing.table(("lost", "what"), [(p.where, p.what) for p in recovery.lost])
        for mended in recovery.mended:
            printing.status(f"{mended.where}: {mended.what}")
        printing.line(f"repaired {'dataset' if output.is_dir() else 'file'} written to {output}")
    return 0 if recovery.complete else LogDamagedError.exit_code


@options.command("index")
@click.argument("corpus", nargs=-1, required=True, type=options.WORD, metavar="PATH...")
@options.output("Parquet file to write. [default: corpus.parquet in the folder PATH]")
@options.option("--deep")
@options.option("--jobs N", type=options.PROCESSES)
@options.as_json
@options.quiet
def index_command(
    corpus: tuple[str, ...], output: Path | None, deep: bool, jobs: int | None, as_json: bool
) -> int:
    """Index many logs: streams, times and damage in one Parquet file.

    The index has a row for each stream, and for each log that cannot be read a row with the reason.
    When the command runs again, it reads only new and changed logs.

    PATH is one of:
        logs                  a folder with logs in it or in folders below
        'logs/**/*.mcap'      a file, or a pattern that names several
        s3://lab/logs/        a folder or file at an s3:// address

    Options:
        --deep: Decode every message, to find image sizes, gaps, and damage that summaries do not
            show.
        --jobs N: Number of parallel processes. [default: number of processors]

    Examples:
        cdmisfa index logs
        cdmisfa index logs --deep --jobs 8
        cdmisfa index monday tuesday -o week.parquet
    """
    from replay.corpus.index import index_logs

    with bar("indexing", "logs") as progress_bar, stoppable() as stop:
        indexed = index_logs(
            corpus,
            output,
            deep=deep,
            jobs=jobs or os.cpu_count() or 1,
            progress=progress_bar.update,
            stop=stop,
        )
    if as_json:
        values = dataclasses.asdict(indexed)
        del values["stopped"]
        printing.document(**values, complete=not indexed.stopped)
    else:
        _print_index(indexed)
    if indexed.stopped:
        printing.status("stopped before all logs were read: run the same command again to continue")
        return stop.exit_code
    return 0


def _print_index(indexed: Indexed) -> None:
    """Print counts of logs, a table of the kinds of logs, and problems."""
    from rich.filesize import decimal

    printing.line(
        f"{counted(indexed.logs, 'log')} in {counted(indexed.files, 'file')}, "
        f"{counted(indexed.streams, 'stream')}: "
        f"{indexed.read} read, {indexed.kept} unchanged, {len(indexed.gone)} removed, "
        f"{indexed.broken} with a problem, {indexed.unread} not read"
    )
    if indexed.kinds:
        head = "kind", "logs", "files", "streams", "length", "size"
        cells = [[KIND_WORDS.get(row[key], row[key]) for key in head[:4]] for row in indexed.kinds]
        sizes = [[duration_text(row["seconds"]), decimal(row["bytes"])] for row in indexed.kinds]
        printing.table(head, [[*a, *b] for a, b in zip(cells, sizes, strict=True)])
    for row in indexed.problems:
        printing.line(f"{row['path']}: {row['problem']}")
    if (more := indexed.broken + indexed.unread - len(indexed.problems)) > 0:
        printing.line(f"and {more} more logs with a problem")
    printing.line(f"index written to {indexed.index}")
