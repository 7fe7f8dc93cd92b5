"""MCAP logs: images or numbers in messages of any kind, of one file or of the parts of a log."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from mcap.records import Channel
from numpy.typing import NDArray

from cdmisfa.core.arrays import IntArray
from recorder.images.messages import Decoder, MessageKind, decoder_of
from recorder.images.options import InputOptions
from recorder.mcap.chunks import MessageTable
from recorder.mcap.reader import LogReader
from recorder.mcap.records import MalformedRecord, Segment
from replay.logs.formats.messages import choose_topics, left_out, message_stream
from replay.logs.stream import LogStream, NothingLoggedError
from replay.storage.paths import natural_order


def streams(
    path: Path, options: InputOptions, opened: ExitStack, *, skip_damaged: bool = False
) -> list[LogStream]:
    """Open the topics of a file, or of a folder whose files are the parts of one log.

    A part may lack a topic, and an empty part is left out.

    Raises:
        UsageError: no such topic, or it has no images or fields as requested.
        LogDamagedError: the log is damaged.
    """
    readers: list[LogReader] = []
    empty: list[NothingLoggedError] = []
    for file in sorted(path.glob("*.mcap"), key=natural_order) if path.is_dir() else [path]:
        reader = opened.enter_context(LogReader(file, skip_damaged=skip_damaged))
        try:
            refuse_empty(reader)
            readers.append(reader)
        except NothingLoggedError as error:
            empty.append(error)
    if not readers:
        raise empty[0]
    channels = [
        (channel.topic, message_kind(reader, channel), (reader, channel.id))
        for reader in readers
        for channel in reader.channels.values()
    ]
    expected: dict[LogReader, Sequence[Segment]] = {}
    opened_streams = []
    chosen = choose_topics(path, channels, options)
    notes = left_out(path, (channel[0] for channel in channels), chosen, options)
    for topic, kind, members in chosen:
        messages, parts = Messages(members, expected), len({reader for reader, _ in members})
        joined = (
            [f"{path}: {topic} is joined from {parts} logs in order of time"] if parts > 1 else []
        )
        skipped = [f"{error}: skipped" for error in empty]
        stream = message_stream(
            path,
            topic,
            kind,
            options,
            messages.times,
            messages.fetch,
            memory_bytes=messages.memory_bytes,
            reader=None if path.is_dir() else readers[0],
            notes=notes,
            missing="; ".join(reader.missing for reader in readers if reader.missing),
            warnings=[*joined, *skipped, *(w for reader in readers for w in reader.warnings)],
        )
        opened_streams.append(stream)
    return opened_streams


class Messages:
    """The messages on a topic, by log time, ties in the order of the files.

    Args:
        channels: channels of the topic, each with the reader of its file.
        expected: chunks that each reader expects next, shared by all topics.

    Attributes:
        times: (n,) log times, nanoseconds.
    """

    def __init__(
        self,
        channels: Sequence[tuple[LogReader, int]],
        expected: dict[LogReader, Sequence[Segment]],
    ) -> None:
        self._expected = expected
        self._channels: dict[LogReader, list[int]] = {}
        for reader, number in channels:
            self._channels.setdefault(reader, []).append(number)
        self._segments: dict[LogReader, list[Segment]] = {}
        self._chunks: list[tuple[LogReader, Segment]] = []
        parts: list[NDArray[np.uint64]] = [np.empty(0, np.uint64)]
        for reader, numbers in self._channels.items():
            by_chunk = _by_index if reader.by_index else _by_pass
            chunks = list(by_chunk(reader, numbers))
            self._segments[reader] = [segment for segment, _ in chunks]
            self._chunks += [(reader, segment) for segment, _ in chunks]
            parts += [log_times for _, log_times in chunks]
        times, counts = np.concatenate(parts), [len(part) for part in parts[1:]]
        order = np.argsort(times, kind="stable")
        self.times = times[order].astype(np.int64)
        self._chunk_of = np.repeat(np.arange(len(counts), dtype=np.int32), counts)[order]
        self._row_in = np.concatenate([np.arange(n) for n in counts] or [order])[order]
        self._now: tuple[int, IntArray] = -1, np.empty(0, int)
        self._bytes = 0
        for reader in self._channels:
            self._expect(reader)

    def fetch(self, row: int) -> memoryview:
        """Read a message; a `MalformedRecord` if its chunk is damaged."""
        number = int(self._chunk_of[row])
        reader, segment = self._chunks[number]
        if number != self._now[0]:
            self._expect(reader)
        table = reader.table(segment)
        if table is None:
            raise MalformedRecord("the message is damaged")
        if number != self._now[0]:
            self._now = number, _rows_of(table, self._channels[reader])
            self._bytes = table.data.nbytes
        rows, place = self._now[1], int(self._row_in[row])
        if place >= len(rows) or int(table.log_time[rows[place]]) != int(self.times[row]):
            raise MalformedRecord("its chunk has other messages than the summary states")
        return table.view(int(rows[place]))

    def memory_bytes(self) -> int:
        """Return bytes of the chunk that was read last."""
        return self._bytes

    def _expect(self, reader: LogReader) -> None:
        """Announce the chunks of the topic, if the last topic that was read has others."""
        if self._expected.get(reader) != self._segments[reader]:
            self._expected[reader] = self._segments[reader]
            reader.expect(self._segments[reader])


def _rows_of(table: MessageTable, channels: Sequence[int]) -> IntArray:
    return np.flatnonzero(np.isin(table.channel, channels))


def _by_pass(
    reader: LogReader, channels: Sequence[int]
) -> Iterator[tuple[Segment, NDArray[np.uint64]]]:
    """Yield the chunks with messages of channels, and their log times, read and checked."""
    for segment, table in reader.tables():
        rows = _rows_of(table, channels)
        if len(rows):
            yield segment, table.log_time[rows]


def _by_index(
    reader: LogReader, channels: Sequence[int]
) -> Iterator[tuple[Segment, NDArray[np.uint64]]]:
    """As `_by_pass`, by the message indexes: a chunk is checked when its messages are read."""
    numbers = set(channels)
    segments = [s for s in reader.segments if not numbers.isdisjoint(s.channel_counts() or ())]
    reader.expect(segments, indexes=True)
    for segment in segments:
        indexes = [pairs for _, pairs in reader.index(segment, numbers)]
        pairs = indexes[0] if len(indexes) == 1 else np.concatenate(indexes)
        yield segment, pairs[pairs[:, 1].argsort(kind="stable"), 0]


def refuse_empty(reader: LogReader) -> None:
    """Refuse a log that was cut before its first message."""
    has_messages = reader.channels and any(segment.size for segment in reader.segments)
    if not reader.complete and not has_messages:
        raise NothingLoggedError(f"{reader.path}: {reader.missing}, before the first message")


def topics_in(reader: LogReader) -> list[str]:
    """Return the topics of a log with images."""
    channels = reader.channels.values()
    topics = (c.topic for c in channels if decoder_of(message_kind(reader, c), InputOptions()))
    return list(dict.fromkeys(topics))


def decoders_in(reader: LogReader) -> dict[int, Decoder]:
    """Return the decoder of each channel of images."""
    channels = [(c.topic, message_kind(reader, c), c.id) for c in reader.channels.values()]
    topics, decoders = topics_in(reader), dict[int, Decoder]()
    options = InputOptions(topics=tuple(topics))
    for _, kind, numbers in choose_topics(reader.path, channels, options) if topics else ():
        decode = decoder_of(kind, options)
        assert decode is not None
        decoders |= dict.fromkeys(numbers, decode)
    return decoders


def message_kind(reader: LogReader, channel: Channel) -> MessageKind:
    """Return the kind of a channel's messages."""
    schema = reader.schemas.get(channel.schema_id)
    if schema is None:
        return MessageKind("no schema", channel.message_encoding)
    return MessageKind(schema.name, channel.message_encoding, schema.data, schema.encoding)
