"""What is in one log, counted, and what is wrong with it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.errors import CdmisfaError, LogDamagedError
from recorder.log.messages import RECORDING_METADATA
from recorder.mcap.reader import LogReader
from recorder.mcap.records import MalformedRecord, Problem, Segment
from recorder.mcap.tables import MessageTable
from replay.runs.folders import RUN_METADATA
from replay.storage.location import Location

SCHEMA: Final = 1
"""Rises whenever a key of the JSON of info, verify or recover changes its meaning."""

Kind = Literal["recording", "run", "foreign"]
Crc = Literal["ok", "absent", "bad", "unchecked"]
Times = NDArray[np.uint64]


@dataclass(slots=True)
class ChannelSurvey:
    """How many messages of a channel are there, from when to when (log time, nanoseconds)."""

    messages: int = 0
    start: int | None = None
    end: int | None = None

    def add(self, times: NDArray[Any]) -> None:
        """Take more log times in, (n,) nanoseconds."""
        if len(times):
            low, high = int(times.min()), int(times.max())
            self.messages += len(times)
            self.start = low if self.start is None else min(self.start, low)
            self.end = high if self.end is None else max(self.end, high)


@dataclass(frozen=True, slots=True)
class Survey:
    """What one log is: its messages by channel number, its checksums, and what is wrong."""

    kind: Kind
    channels: Mapping[int, ChannelSurvey]
    crc: Crc
    problems: tuple[Problem, ...]


def kind_of(reader: LogReader) -> Kind:
    """Tell a recording and a run from other logs by their metadata."""
    names = {m.name for m in reader.metadata}
    if RECORDING_METADATA in names:
        return "recording"
    return "run" if RUN_METADATA in names else "foreign"


def _crc(reader: LogReader, decoded: bool) -> Crc:
    if any("CRC" in problem.what for problem in reader.problems):
        return "bad"
    if not decoded:
        return "unchecked"
    return "absent" if reader.crc_absent() else "ok"


def moved(problem: Problem, copy: Path, place: Location) -> Problem:
    """A problem with what was copied called by its own name."""
    return Problem(problem.where.replace(str(copy), str(place)), problem.what)


def said(path: Location, error: CdmisfaError) -> Problem:
    """An error as a problem of the file that it names."""
    return Problem(str(path), str(error).removeprefix(f"{path}: "))


def problems_of(reader: LogReader) -> tuple[Problem, ...]:
    """What was found to be wrong so far, and what is missing at the end."""
    found = [Problem(f"{reader.path}: {p.where}", p.what) for p in reader.problems]
    return (*found, *([Problem(str(reader.path), reader.missing)] if reader.missing else ()))


def survey(
    reader: LogReader, *, decode: bool, told: Callable[[Segment], None] = lambda _: None
) -> Survey:
    """Count the messages of each channel, and collect what is wrong.

    Args:
        reader: of a log; of one behind a URL the summary and few message indexes are read.
        decode: decode every chunk, which finds all damage, and not only where it has no
            message indexes. The file is read in one pass.
        told: of every chunk that is decoded, in file order.

    Raises:
        LogDamagedError: a message index is damaged.
    """
    found = {number: ChannelSurvey() for number in reader.channels}
    if decode:
        for segment, table in reader.one_pass():
            told(segment)
            _add(found, _decoded(table))
    elif reader.by_index:
        _survey_summary(reader, found)
    else:
        for segment in reader.segments:
            indexed = segment.indexes
            _add(found, _indexed(reader, segment) if indexed else _decoded(reader.table(segment)))
    return Survey(kind_of(reader), found, _crc(reader, decode), problems_of(reader))


def _add(found: dict[int, ChannelSurvey], times: Iterable[tuple[int, Times]]) -> None:
    for number, each in times:
        found.setdefault(number, ChannelSurvey()).add(each)


def _decoded(table: MessageTable | None) -> Iterator[tuple[int, Times]]:
    """The log times of each channel's messages in a chunk."""
    if table is not None:
        for number in np.unique(table.channel).tolist():
            yield number, table.log_time[table.channel == number]


def _indexed(reader: LogReader, segment: Segment) -> list[tuple[int, Times]]:
    try:
        return [(number, pairs[:, 0]) for number, pairs in reader.index(segment)]
    except MalformedRecord as error:
        raise LogDamagedError(f"{reader.path}: {segment.name}: {error}") from None


def _survey_summary(reader: LogReader, found: dict[int, ChannelSurvey]) -> None:
    """Count by the summary.

    A channel begins in one of the chunks that begin before any message of it that is known.
    """
    chunks: dict[int, list[tuple[Segment, int]]] = {}
    for segment in reader.segments:
        for number, count in (segment.channel_counts() or {}).items():
            if count:
                chunks.setdefault(number, []).append((segment, count))
    for number, counted in chunks.items():
        channel, segments = found[number], [segment for segment, _ in counted]
        for segment in sorted(segments, key=lambda s: s.start):
            if channel.start is not None and segment.start >= channel.start:
                break
            channel.add(_times_of(reader, segment, number))
        for segment in sorted(segments, key=lambda s: s.end, reverse=True):
            if channel.end is not None and segment.end <= channel.end:
                break
            channel.add(_times_of(reader, segment, number))
        channel.messages = sum(count for _, count in counted)


def _times_of(reader: LogReader, segment: Segment, number: int) -> Times:
    return np.concatenate([times for n, times in _indexed(reader, segment) if n == number])
