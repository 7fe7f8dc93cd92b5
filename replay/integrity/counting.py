"""How many messages each channel of a log has, and from when to when."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.errors import CdmisfaError, LogDamagedError
from recorder.mcap.chunks import MessageTable
from recorder.mcap.reader import LogReader
from recorder.mcap.records import MalformedRecord, Segment

Times = NDArray[np.uint64]
Result = TypeVar("Result")


@dataclass(slots=True)
class ChannelCount:
    """How many messages of a channel there are, from when to when (log time, nanoseconds)."""

    messages: int = 0
    start: int | None = None
    end: int | None = None

    def add(self, times: Times) -> None:
        """Take more messages in, by their log times, (n,) nanoseconds."""
        self.messages += len(times)
        self.widen(times)

    def widen(self, times: Times) -> None:
        """Take log times in of messages that are counted otherwise, (n,) nanoseconds."""
        if len(times):
            low, high = int(times.min()), int(times.max())
            self.start = low if self.start is None else min(self.start, low)
            self.end = high if self.end is None else max(self.end, high)


def read_once(path: Path, work: Callable[[LogReader], Result]) -> Result:
    """Apply a function to the reader of a log, of which each byte is read once if it is whole.

    A log with damage is read again with `salvage`, for what is wrong and where.

    Args:
        path: the log.
        work: reads the log with `LogReader.one_pass`; may raise a CdmisfaError.

    Raises:
        CdmisfaError: it is no log, or of `work`.
    """
    with contextlib.suppress(CdmisfaError), LogReader(path, check="pass") as reader:
        result = work(reader)
        if not reader.problems:
            return result
    with LogReader(path, salvage=True, check="pass") as reader:
        return work(reader)


def count_messages(
    reader: LogReader, *, decode: bool, told: Callable[[Segment], None] = lambda _: None
) -> dict[int, ChannelCount]:
    """Count the messages of each channel.

    Args:
        reader: of a log.
        decode: decode every chunk, which finds all damage. The file is read in one pass.
        told: of every chunk that is decoded, in file order.

    Raises:
        LogDamagedError: a message index is damaged.
    """
    found = {number: ChannelCount() for number in reader.channels}
    if not decode:
        _count_by_index(reader, found)
        return found
    for segment, table in reader.one_pass():
        told(segment)
        for number in () if table is None else np.unique(table.channel).tolist():
            times = _times_in(table, number)
            found.setdefault(number, ChannelCount()).add(times)
    return found


def _count_by_index(reader: LogReader, found: dict[int, ChannelCount]) -> None:
    """Count by the indexes of chunks.

    A channel begins in one of the chunks that begin before any message of it that is known.
    """
    chunks: dict[int, list[Segment]] = {}
    for segment in reader.segments:
        counts = segment.channel_counts()
        if counts is None:
            table = reader.table(segment)
            counts = {} if table is None else Counter(table.channel.tolist())
        for number, count in counts.items():
            if count:
                chunks.setdefault(number, []).append(segment)
                found.setdefault(number, ChannelCount()).messages += count
    for number, segments in chunks.items():
        channel = found[number]
        for segment in sorted(segments, key=lambda s: s.start):
            if channel.start is not None and segment.start >= channel.start:
                break
            channel.widen(_times_of(reader, segment, number))
        for segment in sorted(segments, key=lambda s: s.end, reverse=True):
            if channel.end is not None and segment.end <= channel.end:
                break
            channel.widen(_times_of(reader, segment, number))


def _times_of(reader: LogReader, segment: Segment, number: int) -> Times:
    """Log times of a channel's messages in a chunk, by its message index if it has one."""
    if not segment.indexes:
        return _times_in(reader.table(segment), number)
    try:
        pairs = reader.index(segment)
    except MalformedRecord as error:
        raise LogDamagedError(f"{reader.path}: {segment.name}: {error}") from None
    return np.concatenate([own[:, 0] for channel, own in pairs if channel == number])


def _times_in(table: MessageTable | None, number: int) -> Times:
    return np.empty(0, np.uint64) if table is None else table.log_time[table.channel == number]
