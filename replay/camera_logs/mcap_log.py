"""The images on one topic of an MCAP log."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.errors import UsageError
from recorder.images.decoding import MessageKind, decoder_of
from recorder.images.fields import NUMBERS_RECIPE
from recorder.images.options import IMAGES, Reading
from recorder.mcap.reader import LogReader
from recorder.mcap.records import Channel, MalformedRecord, Segment
from recorder.mcap.tables import MessageTable
from replay.camera_logs.stream import (
    MessageImages,
    NothingLoggedError,
    choose_images,
    explained,
    sorted_times,
)
from replay.storage.location import Location
from replay.storage.opening import open_store

Found = TypeVar("Found")

_Messages = tuple[list[Segment], Sequence[int], NDArray[np.uint64], NDArray[np.int64]]
"""Chunks with messages of a topic, how many each has, their log times, and the row of each."""


class McapImages(MessageImages):
    """The images, or the numbers, on one topic of one log, in the order of log time.

    Raises:
        UsageError: no such topic, or not what is wanted on it.
        LogDamagedError: the log is damaged.
    """

    def __init__(
        self,
        path: Location,
        topic: str | None,
        *,
        salvage: bool = False,
        reading: Reading = IMAGES,
    ) -> None:
        self.path = path
        self._own: tuple[MessageTable | None, NDArray[np.intp]] = None, np.empty(0, np.intp)
        if reading.fields:
            self.recipe, self.fields = NUMBERS_RECIPE, reading.fields
        self.reader = LogReader(open_store(path), salvage=salvage)
        try:
            _refuse_nothing(self.reader)
            channels = [(c.topic, _kind(self.reader, c), c) for c in self.reader.channels.values()]
            own, self.decode = choose_images(path, topic, channels, reading)
            self._channels = {channel.id for channel in own}
            self.topic, self.kind = own[0].topic, _kind(self.reader, own[0])
            self._index()
        except BaseException:
            self.reader.close()
            raise
        self.warnings = self.reader.warnings

    def taken(self, row: int, take: Callable[[memoryview], Found]) -> Found:
        table = self.reader.table(self._segments[int(self._segment_of[row])])
        if table is None:
            raise MalformedRecord("it is damaged")
        place = int(self._row_in[row])
        if self.reader.by_index:
            if self._own[0] is not table:
                self._own = table, self._rows_of(table)
            own = self._own[1]
            if place >= len(own) or table.log_time[own[place]] != self.times[row]:
                raise MalformedRecord("its chunk holds other messages than the summary names")
            place = int(own[place])
        with explained(self.path, "its decoder", held=table.data.nbytes):
            return take(table.view(place))

    def close(self) -> None:
        self._own = None, self._own[1]
        self.reader.close()

    def _index(self) -> None:
        """Find every message of the topic.

        One pass over a log checks all of it; of a URL only its message indexes are read, and
        each chunk is checked when its images are.
        """
        found = self._by_index() if self.reader.by_index else self._by_pass()
        self._segments, counts, log_times, places = found
        if not len(log_times):
            raise UsageError(f"{self.path}: there is no message on {self.topic}")
        members = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
        order = np.argsort(log_times, kind="stable")
        self.times = sorted_times(f"{self.path}: {self.topic}", log_times[order])
        self._segment_of, self._row_in = members[order], places[order]
        self.reader.expect(self._segments)

    def _by_pass(self) -> _Messages:
        """The topic's messages by their rows in the table of each chunk."""
        segments, times, places = [], [np.empty(0, np.uint64)], [np.empty(0, np.int64)]
        for segment, table in self.reader.tables(ordered=False):
            own = self._rows_of(table)
            if len(own):
                segments.append(segment)
                times.append(table.log_time[own])
                places.append(own)
        counts = [len(own) for own in times[1:]]
        return segments, counts, np.concatenate(times), np.concatenate(places)

    def _rows_of(self, table: MessageTable) -> NDArray[np.intp]:
        """The rows of a chunk's table that are of the topic."""
        return np.flatnonzero(np.isin(table.channel, list(self._channels)))

    def _by_index(self) -> _Messages:
        """The topic's messages by their rows among its own in each chunk."""
        own_ids = self._channels
        segments = [
            segment
            for segment in self.reader.segments
            if any(n for c, n in (segment.channel_counts() or {}).items() if c in own_ids)
        ]
        self.reader.expect(segments, indexes=True)
        found, counts = [np.empty((0, 2), np.uint64)], []
        for segment in segments:
            own = [pairs for channel, pairs in self.reader.index(segment) if channel in own_ids]
            found += own
            counts.append(sum(map(len, own)))
        pairs, first = np.concatenate(found), np.cumsum(counts) - counts
        # In each chunk they stand by their offsets.
        order = np.lexsort((pairs[:, 1], np.repeat(np.arange(len(counts)), counts)))
        return segments, counts, pairs[order, 0], np.arange(len(pairs)) - np.repeat(first, counts)


def mcap_topics(path: Location, reading: Reading = IMAGES) -> list[str]:
    """The topics of an MCAP log with what is wanted.

    Raises:
        LogDamagedError: it is no MCAP file, or has nothing in it.
    """
    with LogReader(open_store(path), salvage=True) as reader:
        _refuse_nothing(reader)
        channels = reader.channels.values()
        found = (c.topic for c in channels if decoder_of(_kind(reader, c), reading) is not None)
        return list(dict.fromkeys(found))


def _refuse_nothing(reader: LogReader) -> None:
    """Refuse a log that was cut before its first message."""
    there = reader.channels and any(segment.size for segment in reader.segments)
    if not reader.complete and not there:
        raise NothingLoggedError(f"{reader.path}: {reader.missing}: there is no message before")


def _kind(reader: LogReader, channel: Channel) -> MessageKind:
    schema = reader.schemas.get(channel.schema_id)
    if schema is None:
        return MessageKind("no schema", channel.encoding)
    return MessageKind(schema.name, channel.encoding, schema.data, schema.encoding)
