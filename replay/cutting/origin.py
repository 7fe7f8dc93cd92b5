"""A log that is cut: what of it is wanted, and which of its chunks can be copied as they are."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from cdmisfa.core.errors import UsageError
from recorder.log.manifest import ViewMetadata
from recorder.log.messages import RECORDING_METADATA, TRUTH_TOPIC, view_topic
from recorder.mcap.chunks import confirm
from recorder.mcap.reader import LogReader
from recorder.mcap.records import (
    INDEX_HEADER,
    Channel,
    IndexPart,
    Problem,
    Schema,
    Segment,
)
from recorder.mcap.store import Store
from recorder.mcap.tables import MessageTable
from replay.runs.folders import RUN_METADATA
from replay.segments import FOREVER, spans_of, within
from replay.segments import Segment as Wanted
from replay.stored import Span

_MOST: Final = 2**16
"""Ids of a log's schemas, and of its channels."""

_Known = dict[Schema | Channel, int]


class Ids:
    """The schemas and channels of logs that become one; whose id is free keeps it."""

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self._known: _Known = {}
        self._next: dict[type, int] = {}

    def take(self, reader: LogReader) -> dict[int, int]:
        """Take the definitions of a log in; the ids of its channels here, by those there.

        A channel that an earlier log has, too, is the same.
        """
        before, schemas = dict(self._known), {0: 0}
        for number, schema in reader.schemas.items():
            schemas[number] = self._place(self.schemas, schema, before)
        return {
            number: self._place(
                self.channels,
                replace(channel, schema_id=schemas.get(channel.schema_id, channel.schema_id)),
                before,
            )
            for number, channel in reader.channels.items()
        }

    def _place(self, known: dict[int, Any], new: Schema | Channel, before: _Known) -> int:
        """The id by which a definition is known from now on."""
        alike = replace(new, id=0)
        if known.get(new.id) == new:
            return new.id
        if (number := before.get(alike)) is not None:
            return number
        number = new.id
        while number in known:
            number = self._next[type(new)] = self._next.get(type(new), 0) + 1
        if number >= _MOST:
            raise UsageError(f"a log has fewer than {_MOST} channels and schemas: join fewer logs")
        known[number] = replace(new, id=number)
        self._known.setdefault(alike, number)
        return number


@dataclass(frozen=True, slots=True)
class Whole:
    """A chunk that is copied as it is.

    Attributes:
        data: its bytes, and those of its message indexes, until the next one is read.
        chunk: what it is, where it was.
        pairs: by channel log time and place of each message, (n, 2).
    """

    data: memoryview
    chunk: Segment
    pairs: Mapping[int, NDArray[np.uint64]]

    @property
    def messages(self) -> int:
        """How many it holds."""
        return sum(map(len, self.pairs.values()))

    @property
    def in_order(self) -> bool:
        """Whether they stand in the order of log time."""
        pairs = np.concatenate(list(self.pairs.values()))
        times = pairs[pairs[:, 1].argsort(kind="stable"), 0]
        return bool((times[1:] >= times[:-1]).all())


class Origin:
    """A log that is cut.

    Args:
        path: the log.
        wanted: what of it.
        salvage: leave out what is damaged.

    Attributes:
        reader: of the log.
        spans: by channel the log times that are wanted, of those of which some are.
        chunks: which hold some of them, in file order.
        renamed: by channel the id in the new log; see `name`.
        view: what it states as the view of a recording, None where it is none.

    Raises:
        UsageError: there is no such log, or it is one that is not cut.
        LogDamagedError: it is damaged.
    """

    def __init__(self, path: Path, wanted: Sequence[Wanted], *, salvage: bool = False) -> None:
        self.path, self.wanted = path, wanted
        self.reader = reader = LogReader(path, salvage=salvage)
        self._buffer = bytearray()
        self._last: tuple[Segment | None, MessageTable | None] = None, None
        try:
            topics = {c.topic: spans_of(wanted, c.topic) for c in reader.channels.values()}
            channels = reader.channels.items()
            self.spans = {number: topics[c.topic] for number, c in channels if topics[c.topic]}
            self.chunks = [s for s in reader.segments if not (s.cut and s.crc) and self._touches(s)]
            self.view = self._view(topics)
        except BaseException:
            reader.close()
            raise
        reader.expect(self.chunks)
        self._file: Store = reader.data.file
        self._vouched = reader.data.vouched and not (reader.by_index or reader.problems)

    def name(self, ids: Ids) -> None:
        """Take over the ids that its channels have in the new log."""
        self.renamed = ids.take(self.reader)
        schemas = self.reader.schemas
        same = all(ids.schemas[number] == schema for number, schema in schemas.items())
        self._same = same and all(number == new for number, new in self.renamed.items())

    @contextlib.contextmanager
    def read(self) -> Iterator[None]:
        """Read the log; where most of it is copied, its checksum vouches for it at the end.

        Raises:
            LogDamagedError: it does not.
        """
        data, reader = self.reader.data, self.reader
        most = 2 * sum(s.stop - s.offset for s in self.chunks if self._covers(s)) > reader.size
        if not (most and self._same and data.vouched and reader.by_index):
            yield
            return
        with data.passing() as self._file:
            self._vouched = True
            yield

    @property
    def problems(self) -> list[Problem]:
        """What is damaged, and what is missing at the end."""
        reader, path = self.reader, str(self.path)
        missing = [Problem(path, reader.missing)] if reader.missing else []
        return [*(Problem(f"{path}: {p.where}", p.what) for p in reader.problems), *missing]

    def table(self, chunk: Segment) -> MessageTable | None:
        """The messages of a chunk that are wanted; None where it is damaged."""
        if self._last[0] is not chunk:
            table = self.reader.table(chunk)
            if table is not None:
                keep = np.zeros(len(table), np.bool_)
                for number in self.spans.keys() & np.unique(table.channel).tolist():
                    keep |= (table.channel == number) & within(table.log_time, self.spans[number])
                table = table if keep.all() else table.select(keep)
            self._last = chunk, table
        return self._last[1]

    def whole(self, chunk: Segment) -> Whole | None:
        """A chunk as it is, where all of it is wanted and no id of it changes."""
        if not (self._same and chunk.chunked and not chunk.cut and chunk.size):
            return None
        if self._vouched and chunk.indexes:
            if not self._covers(chunk):
                return None
            data = self._bytes(chunk)
            pairs = _pairs(data, chunk)
            return None if pairs is None else Whole(data, chunk, pairs)
        table = self.reader.table(chunk)
        if table is None or not self._wants(table):
            return None
        data = self._bytes(chunk)
        pairs = _pairs(data, chunk)
        if pairs is None or not table.agrees(list(pairs.items())):
            return self._indexed(chunk, table)
        return Whole(data, chunk, pairs)

    def as_json(self) -> dict[str, Any]:
        """What the log is, and what was wanted of it, as JSON values."""
        rows = [[s.start, None if s.stop >= FOREVER else s.stop, s.topic] for s in self.wanted]
        return {"file": self.path.name, "bytes": self.reader.size, "wanted": rows}

    def close(self) -> None:
        """Close the log; harmless when called twice."""
        self.reader.close()

    def _wants(self, table: MessageTable) -> bool:
        """Whether all messages of a chunk are wanted."""
        numbers = np.unique(table.channel).tolist()
        known = len(table) > 0 and self.spans.keys() >= set(numbers)
        return known and all(
            within(table.log_time[table.channel == n], self.spans[n]).all() for n in numbers
        )

    def _indexed(self, chunk: Segment, table: MessageTable) -> Whole | None:
        """A chunk with message indexes made of its messages, in place of those it has."""
        at, indexes, parts = chunk.data_end, b"", []
        for number in np.unique(table.channel).tolist():
            index = table.index(number)
            count = (len(index) - INDEX_HEADER.size) // 16
            parts.append(IndexPart(number, at + len(indexes) + INDEX_HEADER.size, count))
            indexes += index
        own = replace(chunk, indexes=[], counts=None)
        data = memoryview(bytes(self._bytes(own)) + indexes)
        own.indexes = parts
        pairs = _pairs(data, own)
        return None if pairs is None else Whole(data, own, pairs)

    def _bytes(self, chunk: Segment) -> memoryview:
        """The bytes of a chunk and of its message indexes, in memory that is used again."""
        size = chunk.stop - chunk.offset
        if size > len(self._buffer):
            self._buffer = bytearray(size)
        data = memoryview(self._buffer)[:size]
        self._file.read_into(chunk.offset, data)
        if chunk.stated:
            confirm(chunk, data)
        return data

    def _touches(self, chunk: Segment) -> bool:
        """Whether some messages of a chunk may be wanted, as far as its header says."""
        counts = chunk.channel_counts()
        numbers = self.spans if counts is None else [n for n, c in counts.items() if c]
        return any(
            start <= chunk.end and chunk.start < stop
            for number in numbers
            for start, stop in self.spans.get(number, ())
        )

    def _covers(self, chunk: Segment) -> bool:
        """Whether all messages of a chunk are wanted, as its header says."""
        counts = chunk.channel_counts() or {}
        return any(counts.values()) and all(
            any(start <= chunk.start and chunk.end < stop for start, stop in self.spans.get(n, ()))
            for n, count in counts.items()
            if count
        )

    def _view(self, topics: Mapping[str, list[Span]]) -> ViewMetadata | None:
        """What the log states as a view of a recording, of which all topics are cut alike."""
        records = {record.name: record.values for record in self.reader.metadata}
        if RUN_METADATA in records:
            raise UsageError(
                f"{self.path} is the log of a run, which is not cut: cdmisfa export makes tables "
                "of its signals, cdmisfa fork goes on from some iteration"
            )
        if RECORDING_METADATA not in records:
            return None
        view = ViewMetadata.parse(self.path, records[RECORDING_METADATA])
        topic = view_topic(view.view)
        needed = [topic, *([TRUTH_TOPIC] if view.truth else [])]
        if any(topics.get(one) != topics.get(topic) for one in needed) or not topics.get(topic):
            raise UsageError(
                f"{self.path} is a view of a recording, with its frames on {' and '.join(needed)}: "
                "cut these alike, or leave --topic out"
            )
        return view


def _pairs(data: memoryview, chunk: Segment) -> dict[int, NDArray[np.uint64]] | None:
    """The message indexes of a chunk by channel; None where they are not what is said of them."""
    found: dict[int, NDArray[np.uint64]] = {}
    at = chunk.data_end
    for part in chunk.indexes:
        place, size = at - chunk.offset, 16 * part.count
        head = INDEX_HEADER.pack(Opcode.MESSAGE_INDEX, size + 6, part.channel, size)
        stop = place + INDEX_HEADER.size
        if data[place:stop] != head or part.channel in found:
            return None
        pairs = np.frombuffer(data, np.uint64, 2 * part.count, stop).reshape(-1, 2)
        found[part.channel] = pairs
        at += INDEX_HEADER.size + size
    times = [pairs[:, 0] for pairs in found.values() if len(pairs)]
    inside = all(chunk.start <= t.min() and t.max() <= chunk.end for t in times)
    return found if times and inside and at == chunk.stop else None
