"""Filtering, splitting and joining MCAP logs, chunk by chunk where a chunk is wanted in all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import LogDamagedError, UsageError
from recorder.log.files import (
    PARTIAL,
    refuse_existing,
    refuse_taken,
)
from recorder.mcap.reader import LogReader
from recorder.mcap.records import Problem
from recorder.mcap.records import Segment as Chunk
from recorder.mcap.tables import MessageTable, in_order, overlapping
from replay.camera_logs.opening import only_foreign
from replay.cutting.origin import Origin
from replay.cutting.output import Output, Part
from replay.inputs import locations
from replay.segments import FOREVER, Segment, read_segments
from replay.storage.opening import log_files

if TYPE_CHECKING:
    from recorder.config import Split

SCHEMA: Final = 1
"""Version of `Cut.as_json`."""

Wanted = dict[Path, list[Segment]]
"""What is wanted of each log."""


Told = Callable[[int, int], None]
"""Told of the bytes of chunks that are read, and of how many there are."""


@dataclass(frozen=True, slots=True)
class Cut:
    """What was written, and what of the logs is damaged and left out."""

    files: tuple[Part, ...]
    problems: tuple[Problem, ...]

    def as_json(self) -> dict[str, Any]:
        """The same as JSON values."""
        return {"schema": SCHEMA, "complete": not self.problems, **asdict(self)}


def cut_logs(
    logs: Sequence[str | Path],
    out: str | Path,
    *,
    start: float = 0.0,
    stop: float | None = None,
    topics: Sequence[str] = (),
    segments: str | Path | None = None,
    split: Split | None = None,
    force: bool = False,
    told: Told = lambda done, total: None,
) -> Cut:
    """Write the messages of MCAP logs that are wanted into logs of their own, as they are.

    Args:
        logs: files, folders or URLs, or patterns of them.
        out: an MCAP file, in which all are joined by log time; else a folder with a file for each.
        start: from when on, seconds after the first message of all.
        stop: until when.
        topics: only these, or of these patterns.
        segments: a list of what is wanted; see `read_segments`.
        split: where a new file begins.
        force: overwrite what is there.
        told: of each file that is written; see `Told`.

    Raises:
        UsageError: no such log, nothing in it is wanted, or one that is not cut so.
        LogDamagedError: nothing of the logs can be read.
        LogWriteError: the disk does not take it.
    """
    out = Path(out)
    files = [file for place in locations(logs) for file in _files(place)]
    wanted = _wanted(files, topics, None if segments is None else Path(segments))
    if start or stop is not None:
        if segments is not None:
            raise UsageError("the list of segments says which times: leave out --from and --to")
        if stop is not None and not start < stop:
            raise UsageError(f"--from {start:g} is no earlier than --to {stop:g}")
        zero = min(map(_first_time, wanted))
        low = zero + round(start * NANOSECONDS)
        high = FOREVER if stop is None else zero + round(stop * NANOSECONDS)
        wanted = {f: [Segment(low, high, s.topic) for s in own] for f, own in wanted.items()}
    targets = _targets(wanted, out, force)
    parts: list[Part] = []
    problems: list[Problem] = []
    ends: dict[str, int] = {}
    for target, own in targets.items():
        try:
            made, wrong = _written(target, own, split, ends, told, force)
        except LogDamagedError as error:
            if len(targets) == 1:
                raise
            made, wrong = [], [_problem(next(iter(own)), error)]
        parts += made
        problems += wrong
    if not parts:
        raise UsageError(
            f"{files[0] if files else segments}: no message there is of these times and topics; "
            "cdmisfa info lists them"
        )
    return Cut(tuple(parts), tuple(problems))


def _files(place: Path) -> list[Path]:
    if place.exists() and only_foreign(place):
        raise UsageError(
            f"{place} is no MCAP file, and others are not cut: learn and convert take a part with "
            "--from and --to"
        )
    return log_files(place)


def _wanted(files: Sequence[Path], topics: Sequence[str], listed: Path | None) -> Wanted:
    """What is wanted of each log, by topics and a list of segments."""
    if not files and listed is None:
        raise UsageError("no log was named: name one, or a list of them with --segments")
    found: Wanted = {}
    rows = [(None, Segment())] if listed is None else read_segments(listed)
    for place, segment in rows:
        if place is None and not files:
            raise UsageError(f"{listed}: a segment names no log: name one beside it")
        if place is not None and files:
            raise UsageError(f"{listed}: its segments name their logs: name no others beside it")
        own = [segment]
        if topics and segment.topic == "*":
            own = [Segment(segment.start, segment.stop, topic) for topic in topics]
        for file in files if place is None else _files(place):
            found.setdefault(file, []).extend(own)
    return found


def _first_time(file: Path) -> int:
    with LogReader(file, salvage=True, check="chunks") as reader:
        return min((s.start for s in reader.segments if s.size), default=FOREVER)


def _targets(wanted: Wanted, out: Path, force: bool) -> dict[Path, Wanted]:
    """What goes into which file."""
    if out.suffix == ".mcap":
        targets = {out: wanted}
    else:
        refuse_existing(out, force=force, goes_on=False)
        targets = {}
        for file, name in _names(wanted).items():
            own, target = wanted[file], out / name
            if target in targets:
                raise UsageError(
                    f"{file}: another log is called {file.name}, too: cut each by itself, or join "
                    "them in a file: -o NAME.mcap"
                )
            targets[target] = {file: own}
    for target, those in targets.items():
        refuse_taken(target, force=force)
        for file in those:
            if target.exists() and target.samefile(file):
                raise UsageError(f"{file}: it cannot be cut into itself, name another file")
    return targets


def _names(files: Collection[Path]) -> dict[Path, str]:
    """A name for each log; with the folders that they differ by, where two have the same."""
    names = {file: file.name.removesuffix(PARTIAL) for file in files}
    here = {file: os.path.abspath(file) for file in files}
    if len(set(names.values())) < len(names) == len(here):
        above = os.path.commonpath([os.path.dirname(file) for file in here.values()])
        names = {f: os.path.relpath(p, above).removesuffix(PARTIAL) for f, p in here.items()}
    return names


def _written(
    target: Path, wanted: Wanted, split: Split | None, ends: dict[str, int], told: Told, force: bool
) -> tuple[list[Part], list[Problem]]:
    """Write a file, or its parts, and say what is damaged.

    What is damaged shows while it is read: then it is begun again, and that is left out.
    """
    with contextlib.suppress(LogDamagedError):
        return _copied(target, wanted, split, dict(ends), told, force, salvage=False)
    return _copied(target, wanted, split, ends, told, force, salvage=True)


def _copied(
    target: Path,
    wanted: Wanted,
    split: Split | None,
    ends: dict[str, int],
    told: Told,
    force: bool,
    *,
    salvage: bool,
) -> tuple[list[Part], list[Problem]]:
    problems: list[Problem] = []
    with contextlib.ExitStack() as stack:
        origins = []
        for file, own in wanted.items():
            try:
                origins.append(origin := Origin(file, own, salvage=salvage))
            except LogDamagedError as error:
                if not salvage or len(wanted) == 1:
                    raise
                problems.append(_problem(file, error))
            else:
                stack.callback(origin.close)
        with Output(target, origins, split, ends, force=force) as output:
            with contextlib.ExitStack() as read:
                for origin in origins:
                    read.enter_context(origin.read())
                _copy(origins, output, told)
            output.finish()
        return output.parts, [*problems, *(p for origin in origins for p in origin.problems)]


def _copy(origins: Sequence[Origin], output: Output, told: Told) -> None:
    """Copy the chunks of a log in their order, of several logs all messages by log time."""
    of = {id(chunk): origin for origin in origins for chunk in origin.chunks}
    chunks = [chunk for origin in origins for chunk in origin.chunks]
    total, done = sum(chunk.stored for chunk in chunks), 0
    joined = len(origins) > 1
    for group in overlapping(chunks) if joined else ([chunk] for chunk in chunks):
        origin, whole = of[id(group[0])], None
        if len(group) == 1 and output.fits(group[0]):
            whole = origin.whole(group[0])
        if whole is not None and (not joined or whole.in_order):
            output.add_chunk(origin, whole)
        else:
            for chunk, rows in _rows(group, of, joined):
                if len(rows):
                    output.add_rows(of[id(chunk)], rows)
        done += sum(chunk.stored for chunk in group)
        told(done, total)


def _rows(
    group: Sequence[Chunk], of: Mapping[int, Origin], joined: bool
) -> Iterator[tuple[Chunk, MessageTable]]:
    """The messages of chunks that are wanted, by log time where logs are joined."""

    def table(chunk: Chunk) -> MessageTable | None:
        return of[id(chunk)].table(chunk)

    if joined:
        yield from in_order(group, table)
    elif (found := table(group[0])) is not None:
        yield group[0], found


def _problem(file: Path, error: LogDamagedError) -> Problem:
    return Problem(str(file), str(error).removeprefix(f"{file}: "))
