"""The messages of one channel, numbered through all chunks of a file."""

from __future__ import annotations

import bisect
import itertools
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.errors import LogDamagedError
from recorder.log.viewfacts import ViewFacts
from replay.mcap.reader import LogReader
from replay.mcap.records import Bytes, Channel, MalformedRecord
from replay.mcap.segments import Segment
from replay.mcap.tables import MessageTable

_DECODED: Final = 4
_BATCH: Final = 64


@dataclass(frozen=True, slots=True)
class Run:
    """Frames `start` to before `stop`, as the messages of a channel from `row` on."""

    start: int
    stop: int
    row: int

    def row_of(self, frame: int) -> int:
        """Number of the message with a frame of the run."""
        return self.row + frame - self.start


class Rows(Protocol):
    """Decoded messages of one chunk."""

    def rows(self, low: int, high: int) -> NDArray[Any]:
        """Give rows `low` to before `high`, or to the last one."""


@dataclass(frozen=True, slots=True)
class PixelRows:
    """Values that stand as bytes in a chunk: (B - size + 1, size) windows, (n,) places."""

    windows: Bytes
    at: NDArray[np.int64]

    def rows(self, low: int, high: int) -> Bytes:
        """Copy the values of some messages, (high - low, size)."""
        return self.windows[self.at[low:high]]


@dataclass(frozen=True, slots=True)
class TruthRows:
    """Ground truth of a chunk, (n, D)."""

    values: NDArray[np.float64]

    def rows(self, low: int, high: int) -> NDArray[np.float64]:
        """Give the ground truth of some messages, (high - low, D)."""
        return self.values[low:high]


class Piece(NamedTuple):
    """Messages of one channel that stand in one chunk.

    Attributes:
        offset: place of the chunk in the file.
        segment: the chunk.
        which: the channel: 0 frames, 1 ground truth.
        low: the first of them among the channel's messages in the chunk.
        n: how many.
        at: the first of them among the messages asked for.
    """

    offset: int
    segment: Segment
    which: int
    low: int
    n: int
    at: int


class ChannelRows:
    """The messages of one channel, numbered through all chunks of a file.

    Args:
        reader: the file.
        channel: the channel.
        decode: gives for the channel's messages of one chunk an array with a row each.
    """

    def __init__(
        self, reader: LogReader, channel: Channel, decode: Callable[[MessageTable], Rows]
    ) -> None:
        self.channel = channel
        self._reader = reader
        self._decode = decode
        self._decoded: OrderedDict[int, Rows] = OrderedDict()
        self._segments: list[Segment] = []
        self._to_confirm: dict[int, ViewFacts] = {}
        self._starts = [0]
        self._taken: list[Segment] = []
        self._take_segments()

    def runs(self, facts: ViewFacts, *, salvage: bool) -> list[Run]:
        """Number the messages by their log time.

        Args:
            facts: the clock of the recording.
            salvage: take gaps and damaged chunks as several runs.

        Raises:
            LogDamagedError: a log time that is no frame's, a frame twice or out of order,
                and without `salvage` a frame that is missing.
        """
        if self._reader.by_index and not salvage:
            return self._stated_runs(facts)
        return self._runs_from(0, facts, salvage)

    def extended(self, facts: ViewFacts) -> list[Run]:
        """Number the messages of a file that its recorder has made longer; as `runs`.

        Raises:
            LogDamagedError: as `runs`, without `salvage`.
        """
        return self._runs_from(self._take_segments(), facts, False)

    def _take_segments(self) -> int:
        """Take in the chunks that hold messages; how many of those before are as they were."""
        segments = self._reader.segments
        if self._taken and self._taken[-1] is not segments[len(self._taken) - 1]:
            last = self._taken.pop()
            if self._segments and self._segments[-1] is last:
                self._segments.pop()
                self._starts.pop()
                self._decoded.pop(len(self._segments), None)
        kept = len(self._segments)
        for segment in segments[len(self._taken) :]:
            count = self._count(segment)
            if count:
                self._segments.append(segment)
                self._starts.append(self._starts[-1] + count)
        self._taken = segments[:]
        return kept

    def _runs_from(self, first: int, facts: ViewFacts, salvage: bool) -> list[Run]:
        """Number the messages, those in the chunks before the `first`th without a look at them."""
        row = self._starts[first]
        found = [Run(facts.first_frame, facts.first_frame + row, 0)] if row else []
        batch: list[NDArray[np.uint64]] = []
        for number in range(first, len(self._segments)):
            damaged = salvage and self._reader.table(self._segments[number]) is None
            if damaged or len(batch) >= _BATCH:
                self._number(batch, row, facts, found, salvage)
                row, batch = self._starts[number + damaged], []
            if not damaged:
                try:
                    batch.append(self._times(number))
                except MalformedRecord as error:
                    raise LogDamagedError(f"{self._reader.path}: {error}") from None
        self._number(batch, row, facts, found, salvage)
        return found

    def _stated_runs(self, facts: ViewFacts) -> list[Run]:
        """Number the messages by how many the summary says each chunk has.

        Each chunk's log times are compared with this when it is read.
        """
        self._to_confirm = dict.fromkeys(range(len(self._segments)), facts)
        count = self._starts[-1]
        return [Run(facts.first_frame, facts.first_frame + count, 0)] if count else []

    def _confirm(self, number: int) -> None:
        """Check the log times of a chunk whose frames were numbered by the summary."""
        facts = self._to_confirm.get(number)
        if facts is None:
            return
        start = facts.first_frame + self._starts[number]
        before = [Run(facts.first_frame, start, 0)] if self._starts[number] else []
        try:
            self._number([self._times(number)], self._starts[number], facts, before, False)
        except MalformedRecord as error:
            raise LogDamagedError(f"{self._reader.path}: {error}") from None
        del self._to_confirm[number]

    def _number(
        self,
        batch: list[NDArray[np.uint64]],
        row: int,
        facts: ViewFacts,
        found: list[Run],
        salvage: bool,
    ) -> None:
        """Add the frames of messages from `row` on to the runs found."""
        if not batch:
            return
        times = np.concatenate(batch)
        frames = facts.frames_at(times)
        exact = facts.times(frames) == times
        before = found[-1].stop if found else facts.first_frame
        steps = np.diff(frames, prepend=before - 1)
        wrong = np.flatnonzero(~exact | (steps < 1 if salvage else steps != 1))
        if len(wrong):
            at = int(wrong[0])
            raise LogDamagedError(
                f"{self._reader.path}: {self.channel.topic}: after frame "
                f"{int(frames[at]) - int(steps[at])} comes log time {times[at]} ns, frame "
                f"{frames[at]}: frames are missing or doubled; run cdmisfa verify; "
                "cdmisfa learn --salvage leaves out what is missing"
            )
        edges = [0, *(np.flatnonzero(steps[1:] != 1) + 1).tolist(), len(frames)]
        for low, high in itertools.pairwise(edges):
            start = int(frames[low])
            if found and found[-1].stop == start and found[-1].row_of(start) == row + low:
                found[-1] = Run(found[-1].start, start + high - low, found[-1].row)
            else:
                found.append(Run(start, start + high - low, row + low))

    def _times(self, number: int) -> NDArray[np.uint64]:
        """Log times of the messages in the `number`th chunk that holds any."""
        segment = self._segments[number]
        if segment.indexes:
            own = [p[:, 0] for c, p in self._reader.index(segment) if c == self.channel.id]
            return own[0] if len(own) == 1 else np.concatenate(own)
        return self._table(number).log_time

    def first(self, row: int) -> bytes:
        """Copy the payload of one message."""
        number = bisect.bisect_right(self._starts, row) - 1
        return self._table(number).payload(row - self._starts[number])

    def fill(self, row: int, out: NDArray[Any]) -> None:
        """Fill `out` with the decoded messages from `row` on.

        Raises:
            LogDamagedError: a chunk or a message in it is damaged.
        """
        at, count = 0, len(out)
        number = bisect.bisect_right(self._starts, row) - 1
        while at < count:
            low = row + at - self._starts[number]
            part = self._rows(number).rows(low, low + count - at)
            out[at : at + len(part)] = part
            at, number = at + len(part), number + 1

    def pieces(self, row: int, count: int, which: int) -> list[Piece]:
        """The chunks that hold `count` messages from `row` on."""
        number, at = bisect.bisect_right(self._starts, row) - 1, 0
        found = []
        while at < count:
            low = row + at - self._starts[number]
            here = min(self._starts[number + 1] - row, count) - at
            segment = self._segments[number]
            found.append(Piece(segment.offset, segment, which, low, here, at))
            self._confirm(number)
            at, number = at + here, number + 1
        return found

    def _count(self, segment: Segment) -> int:
        counts = segment.channel_counts()
        if counts is not None:
            return counts.get(self.channel.id, 0)
        table = self._reader.table(segment)
        return 0 if table is None else int((table.channel == self.channel.id).sum())

    def _rows(self, number: int) -> Rows:
        if number in self._decoded:
            return self._decoded[number]
        try:
            rows = self._decode(self._table(number))
        except MalformedRecord as error:
            raise LogDamagedError(
                f"{self._reader.path}: {self._segments[number].name}: {error}"
            ) from None
        if len(self._decoded) >= _DECODED:
            self._decoded.popitem(last=False)
        self._decoded[number] = rows
        return rows

    def _table(self, number: int) -> MessageTable:
        segment = self._segments[number]
        self._confirm(number)
        table = self._reader.table(segment)
        if table is None:
            raise LogDamagedError(f"{self._reader.path}: {segment.name} is damaged")
        rows = table.select(np.flatnonzero(table.channel == self.channel.id))
        stated = self._starts[number + 1] - self._starts[number]
        if len(rows) != stated:
            raise LogDamagedError(
                f"{self._reader.path}: {segment.name} holds {len(rows)} messages of "
                f"{self.channel.topic!r}, its index says {stated}; run cdmisfa recover"
            )
        return rows
