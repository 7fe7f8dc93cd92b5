"""The images on one topic of an MCAP log."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np
from mcap.records import Channel
from numpy.typing import NDArray

from cdmisfa.core.errors import UsageError
from recorder.images.messages import Decoder, MessageKind, decoder_of
from recorder.images.options import IMAGES, NUMBERS_RECIPE, InputOptions
from recorder.mcap.chunks import MessageTable
from recorder.mcap.reader import LogReader
from recorder.mcap.records import MalformedRecord, Segment
from replay.camera_logs.stream import (
    MessageImages,
    NothingLoggedError,
    choose_images,
    explained,
    sorted_times,
)

Found = TypeVar("Found")


class Readers(contextlib.ExitStack):
    """Logs of which several topics are taken: each is opened once, and closed with this."""

    def __init__(self) -> None:
        super().__init__()
        self._open: dict[Path, LogReader] = {}
        self._expected: dict[LogReader, list[Segment]] = {}

    def reader(self, path: Path, *, salvage: bool) -> LogReader:
        """The reader of a log; raises as `LogReader` does."""
        if path not in self._open:
            self._open[path] = self.enter_context(LogReader(path, salvage=salvage))
        return self._open[path]

    def expect(self, reader: LogReader, segments: list[Segment]) -> None:
        """Say which chunks a topic is about to read, where the one before had others."""
        if self._expected.get(reader) != segments:
            self._expected[reader] = segments
            reader.expect(segments)


class McapImages(MessageImages):
    """The images, or the numbers, on one topic of one log, in the order of log time.

    Args:
        path: the log.
        topic: may be left out where there is one of images.
        salvage: leave out what is damaged.
        reading: what is taken.
        readers: of logs of which other topics are taken, too.

    Raises:
        UsageError: no such topic, or not what is wanted on it.
        LogDamagedError: the log is damaged.
    """

    def __init__(
        self,
        path: Path,
        topic: str | None,
        *,
        salvage: bool = False,
        reading: InputOptions = IMAGES,
        readers: Readers | None = None,
    ) -> None:
        self.path, self.color = path, (reading.color is True)
        self._own: tuple[int, NDArray[np.intp]] = -1, np.empty(0, np.intp)
        if reading.fields:
            self.recipe, self.fields = NUMBERS_RECIPE, reading.fields
        self._alone = Readers()
        self._readers = self._alone if readers is None else readers
        self.reader = self._readers.reader(path, salvage=salvage)
        try:
            _refuse_nothing(self.reader)
            own, self.decode = channels_on(self.reader, topic, reading)
            self._channels = [channel.id for channel in own]
            self.topic, self.kind = own[0].topic, _kind(self.reader, own[0])
            found = list(self._by_index() if self.reader.by_index else self._by_pass())
            if not any(len(own) for _, own in found):
                raise UsageError(f"{path}: there is no message on {self.topic}")
            self._segments = [segment for segment, _ in found]
            log_times = np.concatenate([own for _, own in found])
            order = np.argsort(log_times, kind="stable")
            self.times = sorted_times(f"{path}: {self.topic}", log_times[order])
            counts = [len(own) for _, own in found]
            self._segment_of = np.repeat(np.arange(len(counts), dtype=np.int32), counts)[order]
            self._row_in = np.concatenate([np.arange(count) for count in counts])[order]
            self._readers.expect(self.reader, self._segments)
        except BaseException:
            self._alone.close()
            raise
        self.warnings = self.reader.warnings

    def taken(self, row: int, take: Callable[[memoryview], Found]) -> Found:
        number = int(self._segment_of[row])
        if number != self._own[0]:
            self._readers.expect(self.reader, self._segments)
        table = self.reader.table(self._segments[number])
        if table is None:
            raise MalformedRecord("it is damaged")
        if number != self._own[0]:
            self._own = number, self._rows_of(table)
        own, place = self._own[1], int(self._row_in[row])
        if place >= len(own) or table.log_time[own[place]] != self.times[row]:
            raise MalformedRecord("its chunk holds other messages than the summary names")
        with explained(self.path, "its decoder", held=table.data.nbytes):
            return take(table.view(int(own[place])))

    def close(self) -> None:
        self._alone.close()

    def _rows_of(self, table: MessageTable) -> NDArray[np.intp]:
        """The rows of a chunk's table that are of the topic."""
        return np.flatnonzero(np.isin(table.channel, self._channels))

    def _by_pass(self) -> Iterator[tuple[Segment, NDArray[np.uint64]]]:
        """The chunks with messages of the topic, and their log times, read and checked."""
        for segment, table in self.reader.tables():
            own = self._rows_of(table)
            if len(own):
                yield segment, table.log_time[own]

    def _by_index(self) -> Iterator[tuple[Segment, NDArray[np.uint64]]]:
        """As `_by_pass`, by the message indexes: a chunk is checked when its images are read."""
        channels = set(self._channels)
        segments = [
            segment
            for segment in self.reader.segments
            if not channels.isdisjoint(segment.channel_counts() or ())
        ]
        self.reader.expect(segments, indexes=True)
        for segment in segments:
            own = [pairs for _, pairs in self.reader.index(segment, channels)]
            pairs = own[0] if len(own) == 1 else np.concatenate(own)
            yield segment, pairs[pairs[:, 1].argsort(kind="stable"), 0]


def mcap_topics(path: Path, reading: InputOptions = IMAGES) -> list[str]:
    """The topics of an MCAP log with what is wanted.

    Raises:
        LogDamagedError: it is no MCAP file, or has nothing in it.
    """
    with LogReader(path, salvage=True) as reader:
        _refuse_nothing(reader)
        return topics_in(reader, reading)


def topics_in(reader: LogReader, reading: InputOptions) -> list[str]:
    """Return the topics of a log with what is wanted."""
    channels = reader.channels.values()
    found = (c.topic for c in channels if decoder_of(_kind(reader, c), reading) is not None)
    return list(dict.fromkeys(found))


def channels_on(
    reader: LogReader, topic: str | None, reading: InputOptions
) -> tuple[list[Channel], Decoder]:
    """Return the channels of a topic and the decoder of their messages; see `choose_images`."""
    channels = [(c.topic, _kind(reader, c), c) for c in reader.channels.values()]
    return choose_images(reader.path, topic, channels, reading)


def _refuse_nothing(reader: LogReader) -> None:
    """Refuse a log that was cut before its first message."""
    there = reader.channels and any(segment.size for segment in reader.segments)
    if not reader.complete and not there:
        raise NothingLoggedError(f"{reader.path}: {reader.missing}: there is no message before")


def _kind(reader: LogReader, channel: Channel) -> MessageKind:
    schema = reader.schemas.get(channel.schema_id)
    if schema is None:
        return MessageKind("no schema", channel.message_encoding)
    return MessageKind(schema.name, channel.message_encoding, schema.data, schema.encoding)
