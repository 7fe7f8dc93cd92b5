"""The messages of one channel, numbered through all chunks of a file."""

from __future__ import annotations

import bisect
import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from mcap.records import Channel
from numpy.typing import NDArray

from cdmisfa.core.arrays import ByteArray
from cdmisfa.core.errors import LogDamagedError
from cdmisfa.kernels.frames import gather
from cdmisfa.kernels.frames import layout as kernel_layout
from recorder.log.manifest import ViewMetadata
from recorder.mcap.chunks import MessageTable
from recorder.mcap.reader import LogReader
from recorder.mcap.records import MalformedRecord, Segment


class RowRange(NamedTuple):
    """The frames [start, stop), as the messages of a channel from `row` on."""

    start: int
    stop: int
    row: int


class RowLayout:
    """Where the messages of a channel hold their values, counted from a message's end.

    Args:
        what: a message, as an error names it.
        least: fewest bytes of a message.
        marks: by distance bytes that are the same in every message.
        distances: (R,) of each value.
        width: bytes of a value.
    """

    def __init__(
        self, what: str, least: int, marks: dict[int, int], distances: list[int], width: int
    ) -> None:
        self.what, self.least = what, least
        self.distances, self.width = np.array(distances, np.int64), width
        places, values = list(marks), list(marks.values())
        self._kernel = kernel_layout(least, places, values, distances, width)

    def read(
        self, table: MessageTable, channel: int, rows: tuple[int, int], out: ByteArray | None
    ) -> int:
        """Check messages of a channel, and copy their values; see `gather`.

        Returns:
            How many messages of the channel the chunk holds.

        Raises:
            MalformedRecord: one is laid out otherwise.
        """
        found = gather(table.data, table.records, channel, rows, self._kernel, out)
        if found is None:
            sizes = table.size[table.channel == channel][slice(*rows)]
            wrong = "shorter than" if (sizes < self.least).any() else "laid out unlike"
            raise MalformedRecord(f"{self.what} is {wrong} the others")
        return found


class ChannelRows:
    """The messages of one channel, numbered through all chunks of a file by their log time.

    Args:
        reader: the file.
        channel: the channel.
        facts: the clock of the recording.

    Attributes:
        row_ranges: the frames that are there; one, except where gaps and damage are left out.
        layout: where the messages hold their values, once a message is known.
    """

    def __init__(self, reader: LogReader, channel: Channel, facts: ViewMetadata) -> None:
        self.channel = channel
        self.row_ranges: list[RowRange] = []
        self.layout: RowLayout | None = None
        self._reader = reader
        self._facts = facts
        self._may_lack = reader.salvage or facts.gaps
        self._segments: list[Segment] = []
        self._starts = [0]
        self._unconfirmed: set[int] = set()

    def extend(self) -> None:
        """Number the messages of the whole file.

        Raises:
            LogDamagedError: a log time that is no frame's, a frame twice or out of order, and
                without `salvage` a frame that is missing, unless the file says that it has gaps.
        """
        if self._reader.by_index and not self._may_lack:
            # The log times of each chunk are compared with the summary's count when it is read.
            for segment in self._reader.segments:
                self._take(segment)
            self._unconfirmed.update(range(len(self._segments)))
            first, count = self._facts.first_frame, self._starts[-1]
            self.row_ranges = [RowRange(first, first + count, 0)] if count else []
            return
        for segment in self._reader.segments:
            self.add(segment)

    def add(self, segment: Segment) -> None:
        """Number the messages of the next chunk; raises as `extend`."""
        if not self._take(segment):
            return
        number = len(self._segments) - 1
        if not (self._reader.salvage and self._reader.table(segment) is None):
            self._number(self._times(number), self._starts[number], self.row_ranges)

    def check_last(self, segment: Segment) -> None:
        """Check how messages are laid out in the chunk that was added last, if it is whole.

        Raises:
            LogDamagedError: one is laid out otherwise than others.
        """
        if self._segments and self._segments[-1] is segment:
            number = len(self._segments) - 1
            if self._reader.table(segment) is not None:
                self.read(number, 0, self._starts[-1] - self._starts[-2], None)

    @property
    def ranges(self) -> list[tuple[int, int]]:
        """The frames [start, stop) that there are messages of."""
        return [(one.start, one.stop) for one in self.row_ranges]

    def payload(self, frame: int) -> bytes:
        """The message of a frame."""
        number, low, _ = next(self.pieces(frame, 1))
        return self._own(number).payload(low)

    def pieces(self, frame: int, count: int) -> Iterator[tuple[int, int, int]]:
        """Where the messages of `count` frames of one range are, from a frame on.

        Returns:
            Of each chunk its number among those of the channel, the first message, and how many.
        """
        one = self.row_ranges[
            bisect.bisect_right(self.row_ranges, frame, key=lambda one: one.start) - 1
        ]
        row = one.row + frame - one.start
        stop, number = row + count, bisect.bisect_right(self._starts, row) - 1
        while row < stop:
            start, end = self._starts[number], min(self._starts[number + 1], stop)
            yield number, row - start, end - row
            row, number = end, number + 1

    def place(self, number: int) -> int:
        """Where a chunk begins in the file."""
        return self._segments[number].offset

    def read(self, number: int, low: int, n: int, out: ByteArray | None) -> None:
        """Check how messages of a chunk are laid out, and copy their values.

        Args:
            number: of the chunk among those of the channel.
            low: the first message.
            n: how many.
            out: (n, bytes of a message's values), written; None to check only.

        Raises:
            LogDamagedError: the chunk is damaged, or one is laid out otherwise than others.
        """
        if self.layout is None:
            self._own(number)
            return
        table = self._table(number)
        try:
            found = self.layout.read(table, self.channel.id, (low, low + n), out)
        except MalformedRecord as error:
            where = f"{self._reader.path}: {self._segments[number].name}"
            raise LogDamagedError(f"{where}: {error}") from None
        self._count(number, found)

    def _take(self, segment: Segment) -> bool:
        """Count the channel's messages in the next chunk of the file; whether it has any."""
        counts = segment.channel_counts()
        if counts is None:
            table = self._reader.table(segment)
            count = 0 if table is None else int((table.channel == self.channel.id).sum())
        else:
            count = counts.get(self.channel.id, 0)
        if count:
            self._segments.append(segment)
            self._starts.append(self._starts[-1] + count)
        return count > 0

    def _number(self, times: NDArray[np.uint64], row: int, found: list[RowRange]) -> None:
        """Add the frames of messages from `row` on to the ranges found."""
        frames = self._facts.frames_at(times)
        exact = self._facts.times(frames) == times
        before = found[-1].stop if found else self._facts.first_frame
        steps = np.diff(frames, prepend=before - 1)
        wrong = np.flatnonzero(~exact | (steps < 1 if self._may_lack else steps != 1))
        if len(wrong):
            at = int(wrong[0])
            raise LogDamagedError(
                f"{self._reader.path}: {self.channel.topic}: after frame "
                f"{int(frames[at]) - int(steps[at])} comes log time {times[at]} ns, frame "
                f"{frames[at]}: frames are missing or doubled; {self._remedy()}"
            )
        edges = [0, *(np.flatnonzero(steps[1:] != 1) + 1).tolist(), len(frames)]
        for low, high in itertools.pairwise(edges):
            start, count = int(frames[low]), high - low
            last = found[-1] if found else None
            if last and last.stop == start and last.row + start - last.start == row + low:
                found[-1] = last._replace(stop=start + count)
            else:
                found.append(RowRange(start, start + count, row + low))

    def _remedy(self) -> str:
        if self._reader.salvage:
            return "save what can be read with cdmisfa recover, and learn from that"
        return "cdmisfa verify lists what is missing, cdmisfa learn --salvage leaves it out"

    def _times(self, number: int) -> NDArray[np.uint64]:
        """Log times of the channel's messages in a chunk."""
        segment = self._segments[number]
        if not segment.indexes:
            return self._own(number).log_time
        try:
            own = [p[:, 0] for c, p in self._reader.index(segment) if c == self.channel.id]
        except MalformedRecord as error:
            raise LogDamagedError(f"{self._reader.path}: {error}") from None
        return np.concatenate(own)

    def _table(self, number: int) -> MessageTable:
        """A chunk's messages; raises as `_own`."""
        table = self._reader.table(self._segments[number])
        if table is None:
            raise LogDamagedError(f"{self._reader.path}: {self._segments[number].name} is damaged")
        if number in self._unconfirmed:
            times = table.log_time[table.channel == self.channel.id]
            self._count(number, len(times))
            (row, stop), first = self._starts[number : number + 2], self._facts.first_frame
            if (times != self._facts.times(np.arange(first + row, first + stop))).any():
                # Raises, and says what is wrong.
                self._number(times, row, [RowRange(first, first + row, 0)] if row else [])
            self._unconfirmed.remove(number)
        return table

    def _own(self, number: int) -> MessageTable:
        """The channel's messages in a chunk.

        Raises:
            LogDamagedError: the chunk is damaged, or does not hold what its index says.
        """
        table = self._table(number)
        own = table.select(table.channel == self.channel.id)
        self._count(number, len(own))
        return own

    def _count(self, number: int, found: int) -> None:
        """Compare how many messages of the channel a chunk holds with what its index says."""
        stated = self._starts[number + 1] - self._starts[number]
        if found != stated:
            path, name = self._reader.path, self._segments[number].name
            raise LogDamagedError(
                f"{path}: {name} holds {found} messages of {self.channel.topic!r}, its index says "
                f"{stated}; run cdmisfa recover"
            )
