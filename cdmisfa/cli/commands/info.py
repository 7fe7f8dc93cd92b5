"""`cdmisfa info`: what is in a log, and what was learned in a run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING

import click

from cdmisfa.cli import options
from cdmisfa.cli.printing import (
    outcome_line,
    print_columns,
    print_held_out,
    print_json,
    print_line,
    print_modules,
)
from cdmisfa.core.names import counted

if TYPE_CHECKING:
    from replay.integrity.learned import RunInfo
    from replay.integrity.report import ChannelInfo, LogReport, SizeInfo

MOST_NAMED = 8
"""Streams of a run that are named."""

UNITS = ("bytes", "kB", "MB", "GB", "TB")


@click.command("info")
@click.argument("path", nargs=-1, required=True, type=options.WORD)
@options.as_json
@click.pass_context
def info_command(ctx: click.Context, path: tuple[str, ...], as_json: bool) -> None:
    """Say what is in a recording, a run, any MCAP file, or a camera log.

    PATH may be several, a pattern such as 'logs/*.mcap', or a URL. Exits with 3 when one is cut
    short or damaged, else with 2 when one of several is no log. What only `verify` reads, images
    in logs of others, videos, bags, tables, all above 1 GiB, is called unchecked.
    """
    from replay.integrity.info import describe
    from replay.integrity.report import EXIT_CODES

    found = describe(*path)
    if as_json:
        print_json(found.as_json())
    else:
        _print_info(found)
    ctx.exit(EXIT_CODES[found.state])


def _print_info(found: LogReport) -> None:
    together = all(file.path.startswith(found.path) for file in found.files)
    for each in [found] if together else found.files:
        print_line(f"{each.path}: {', '.join(_words_of(each))}")
    for line in (*(f"{p.where}: {p.what}" for p in found.problems), *found.notes):
        print_line(line)
    if found.run is not None:
        _print_run(found, found.run)
    for line in (*_times(found), *_room(found.size, found.library)):
        print_line(line)
    _print_channels(found.channels)


def _words_of(found: LogReport) -> Iterator[str]:
    """What a log is, and in which state."""
    if found.state == "not read":
        yield found.state
        return
    yield from (found.kind, found.state.replace("unchecked", "contents unchecked"))
    yield f"checksums {found.crc}"
    if found.seed is not None:
        yield f"seed {found.seed}"


def _print_run(found: LogReport, run: RunInfo) -> None:
    """Print what was learned, by which learner, and why it ended."""
    from cdmisfa.experiments.loop import ENDINGS

    more = len(run.streams) - MOST_NAMED
    named = ", ".join(run.streams[:MOST_NAMED]) + (f" and {more} more" if more > 0 else "")
    print_line(f"learner {run.algorithm}, {counted(len(run.streams), 'stream')}: {named}")
    if found.modules or found.ended is not None:  # else they are in its log alone
        print_modules(found.modules, policies=not run.outcomes)
    for outcome in run.outcomes:
        print_line(outcome_line(outcome))
    if found.held_out is not None:
        print_held_out(found.held_out)
    done = f"{counted(run.iterations, 'iteration')} of {counted(run.tau, 'frame')}"
    if found.ended is None:
        print_line(
            f"not ended: {done} so far; it learns, or was stopped before its modules were kept"
        )
    else:
        print_line(f"ended after {done}: {ENDINGS.get(found.ended, found.ended)}")


def _times(found: LogReport) -> Iterator[str]:
    """How much there is, and from when to when."""
    if found.span is None:
        return
    start, end = found.span
    long = f"{(end - start) / 1e9:.3f} s"
    if end - start >= 60 * 10**9:
        long += f" ({timedelta(seconds=round((end - start) / 1e9))})"
    kinds = {c.encoding for c in found.channels}
    shared = f"{kinds.pop()} " if len(kinds) == 1 else ""
    messages = counted(found.messages, f"{shared}message")
    yield f"{messages}, {long}, from {_clock(start)} to {_clock(end)}"


def _room(size: SizeInfo, library: str) -> Iterator[str]:
    """How much room it takes, and how it is compressed."""
    if not size.file:
        return
    told = [in_bytes(size.file)]
    if size.compression:
        chunks = (
            counted(count, f"{name} chunk") for name, count in sorted(size.compression.items())
        )
        told.append(", ".join(chunks))
        if size.decompressed > size.stored:
            share = 1 - size.stored / size.decompressed
            told.append(f"{in_bytes(size.decompressed)} decompressed ({share:.0%} saved)")
    if library:
        told.append(f"written by {library}")
    yield ", ".join(told)


def in_bytes(size: float) -> str:
    """A number of bytes in the unit in which it is read best."""
    power = min(max(len(f"{size:.0f}") - 1, 0) // 3, len(UNITS) - 1)
    return f"{size / 1000**power:.3g} {UNITS[power]}"


def _print_channels(channels: Sequence[ChannelInfo]) -> None:
    """Print a table of them; they begin and end so many seconds after the first message of all."""
    first = min((c.start_ns for c in channels if c.start_ns is not None), default=0)

    def since(ns: int | None) -> str:
        return "-" if ns is None else f"{(ns - first) / 1e9:.3f}"

    columns: dict[str, list[object]] = {
        "topic": [c.topic for c in channels],
        "messages": [c.messages for c in channels],
        "Hz": ["-" if c.rate is None else f"{c.rate:.4g}" for c in channels],
        "from, s": [since(c.start_ns) for c in channels],
        "to, s": [since(c.end_ns) for c in channels],
        "encoding": [c.encoding for c in channels],
        "schema": [c.schema for c in channels],
        "file": [c.file for c in channels],
    }
    for name in ("encoding", "file"):  # what they share is said above
        if len(set(columns[name])) < 2:
            del columns[name]
    print_columns(columns)


def _clock(ns: int) -> str:
    """A log time as date and time of day, UTC, to the millisecond."""
    whole, rest = divmod(ns, 10**9)
    time = datetime.fromtimestamp(whole, tz=UTC)
    return f"{time:%Y-%m-%d %H:%M:%S}.{rest // 10**6:03}Z"
