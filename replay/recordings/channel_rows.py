"""The messages of one channel, numbered through all chunks of a file."""

from __future__ import annotations

import bisect
import itertools
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.errors import LogDamagedError
from recorder.log.manifest import ViewMetadata
from recorder.mcap.reader import LogReader
from recorder.mcap.records import Channel, MalformedRecord, Segment
from recorder.mcap.tables import MessageTable

_BATCH: Final = 64


@dataclass(frozen=True, slots=True)
class Span:
    """The frames [start, stop), as the messages of a channel from `row` on."""

    start: int
    stop: int
    row: int

    def row_of(self, frame: int) -> int:
        """Which message of the channel a frame is in."""
        return self.row + frame - self.start


class Piece(NamedTuple):
    """Messages of one channel that stand in one chunk.

    Attributes:
        segment: the chunk.
        which: the channel: 0 frames, 1 ground truth.
        number: of the chunk among those that hold messages of the channel.
        low: the first of them among the channel's messages in the chunk.
        n: how many.
        at: the first of them among the messages wanted.
    """

    segment: Segment
    which: int
    number: int
    low: int
    n: int
    at: int


class ChannelRows:
    """The messages of one channel, numbered through all chunks of a file by their log time.

    Args:
        reader: the file.
        channel: the channel.
        facts: the clock of the recording.
        passing: number its messages as `pass_over` is told of the chunks.

    Attributes:
        spans: the frames that are there; one, except where gaps and damage are left out.

    Raises:
        LogDamagedError: a log time that is no frame's, a frame twice or out of order, and
            without `salvage` a frame that is missing, unless the file says that it has gaps.
    """

    def __init__(
        self, reader: LogReader, channel: Channel, facts: ViewMetadata, *, passing: bool = False
    ) -> None:
        self.channel = channel
        self._reader = reader
        self._facts = facts
        self._may_lack = reader.salvage or facts.gaps
        self._segments: list[Segment] = []
        self._to_confirm: set[int] = set()
        self._starts = [0]
        self._taken: list[Segment] = []
        self._take_segments()
        self._passed = 0
        if passing:
            self.spans = self._unbroken(0)
        elif reader.by_index and not self._may_lack:
            # Each chunk's log times are compared with the summary when it is read.
            self._to_confirm = set(range(len(self._segments)))
            self.spans = self._unbroken(self._starts[-1])
        else:
            self.spans = self._spans_from(0)

    def extend(self) -> None:
        """Take in what its recorder has added to the file."""
        kept = self._take_segments()
        self.spans = self._spans_from(0 if self._facts.gaps else kept)

    def pass_over(self, segment: Segment) -> MessageTable | None:
        """Number the messages of the next chunk; give them if it is whole and has some."""
        number = self._passed
        if number == len(self._segments) or self._segments[number] is not segment:
            return None
        self._passed += 1
        if self._reader.table(segment) is None:
            return None
        self._number([self._times(number)], self._starts[number], self.spans)
        return self._table(number)

    @property
    def ranges(self) -> list[tuple[int, int]]:
        """The frames [start, stop) that there are messages of."""
        return [(span.start, span.stop) for span in self.spans]

    def _take_segments(self) -> int:
        """Take in the chunks that hold messages; how many of those before are as they were."""
        segments = self._reader.segments
        if self._taken and self._taken[-1] is not segments[len(self._taken) - 1]:
            last = self._taken.pop()
            if self._segments and self._segments[-1] is last:
                self._segments.pop()
                self._starts.pop()
        kept = len(self._segments)
        for segment in segments[len(self._taken) :]:
            count = self._count(segment)
            if count:
                self._segments.append(segment)
                self._starts.append(self._starts[-1] + count)
        self._taken = segments[:]
        return kept

    def _unbroken(self, count: int) -> list[Span]:
        first = self._facts.first_frame
        return [Span(first, first + count, 0)] if count else []

    def _spans_from(self, first: int) -> list[Span]:
        """Number the messages, those in the chunks before the `first`th without a look at them."""
        row, salvage = self._starts[first], self._reader.salvage
        found = self._unbroken(row)
        batch: list[NDArray[np.uint64]] = []
        for number in range(first, len(self._segments)):
            damaged = salvage and self._reader.table(self._segments[number]) is None
            if damaged or len(batch) >= _BATCH:
                self._number(batch, row, found)
                row, batch = self._starts[number + damaged], []
            if not damaged:
                batch.append(self._times(number))
        self._number(batch, row, found)
        return found

    def confirm(self, number: int, times: NDArray[np.uint64]) -> None:
        """Check the log times of a chunk whose frames were numbered by the summary.

        Args:
            number: of the chunk among those that hold messages of the channel.
            times: (>= n,) of its n messages, in file order.

        Raises:
            LogDamagedError: one is not that of its frame.
        """
        if number in self._to_confirm:
            row, first = self._starts[number], self._facts.first_frame
            frames = np.arange(first + row, first + self._starts[number + 1])
            own = times[: len(frames)]
            if (own != self._facts.times(frames)).any():
                self._number([own], row, self._unbroken(row))  # says what is wrong
            self._to_confirm.remove(number)

    def _number(self, batch: list[NDArray[np.uint64]], row: int, found: list[Span]) -> None:
        """Add the frames of messages from `row` on to the spans found."""
        if not batch:
            return
        times = np.concatenate(batch)
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
            start = int(frames[low])
            if found and found[-1].stop == start and found[-1].row_of(start) == row + low:
                found[-1] = Span(found[-1].start, start + high - low, found[-1].row)
            else:
                found.append(Span(start, start + high - low, row + low))

    def _remedy(self) -> str:
        if self._reader.salvage:
            return "save what can be read with cdmisfa recover, and learn from that"
        return "run cdmisfa verify; cdmisfa learn --salvage leaves out what is missing"

    def _times(self, number: int) -> NDArray[np.uint64]:
        """Log times of the messages in the `number`th chunk that holds any."""
        segment = self._segments[number]
        if not segment.indexes:
            return self._table(number).log_time
        try:
            own = [p[:, 0] for c, p in self._reader.index(segment) if c == self.channel.id]
        except MalformedRecord as error:
            raise LogDamagedError(f"{self._reader.path}: {error}") from None
        return own[0] if len(own) == 1 else np.concatenate(own)

    def payload(self, frame: int) -> bytes:
        """The message of a frame."""
        row = self._row(frame)
        number = bisect.bisect_right(self._starts, row) - 1
        return self._table(number).payload(row - self._starts[number])

    def pieces(self, frame: int, count: int, which: int) -> list[Piece]:
        """The chunks that hold the messages of `count` frames from one on, of the same span."""
        row = self._row(frame)
        number, at = bisect.bisect_right(self._starts, row) - 1, 0
        found = []
        while at < count:
            low = row + at - self._starts[number]
            here = min(self._starts[number + 1] - row, count) - at
            found.append(Piece(self._segments[number], which, number, low, here, at))
            at, number = at + here, number + 1
        return found

    def _row(self, frame: int) -> int:
        place = bisect.bisect_right(self.spans, frame, key=lambda span: span.start) - 1
        return self.spans[place].row_of(frame)

    def _count(self, segment: Segment) -> int:
        counts = segment.channel_counts()
        if counts is not None:
            return counts.get(self.channel.id, 0)
        table = self._reader.table(segment)
        return 0 if table is None else int((table.channel == self.channel.id).sum())

    def _table(self, number: int) -> MessageTable:
        own = own_messages(self._reader, self._segments[number], self.channel)
        self.confirm(number, own.log_time)
        return own


def own_messages(reader: LogReader, segment: Segment, channel: Channel) -> MessageTable:
    """The messages of a channel in a chunk.

    Raises:
        LogDamagedError: the chunk is damaged, or holds more or fewer than its index says.
    """
    table = reader.table(segment)
    if table is None:
        raise LogDamagedError(f"{reader.path}: {segment.name} is damaged")
    own = table.select(np.flatnonzero(table.channel == channel.id))
    counts = segment.channel_counts()
    if counts is not None and counts.get(channel.id, 0) != len(own):
        raise LogDamagedError(
            f"{reader.path}: {segment.name} holds {len(own)} messages of {channel.topic!r}, "
            f"its index says {counts.get(channel.id, 0)}; run cdmisfa recover"
        )
    return own
