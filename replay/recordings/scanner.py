"""Where the messages of a view hold their values, and copying these out of chunks.

Chunks that are in order and written as our recorder does it are looked through by a
kernel, in memory that is used again; all others by their tables, which say what is wrong with them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import ByteArray
from cdmisfa.core.errors import LogDamagedError
from cdmisfa.kernels import frames as kernels
from recorder.mcap.reader import LogReader
from recorder.mcap.records import MAX_CHUNK, Channel, MalformedRecord, Place, Segment
from recorder.mcap.tables import MessageTable
from replay.recordings.channel_rows import own_messages

Places = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class RowLayout:
    """Where the messages of a channel hold their values, counted from a message's end.

    Attributes:
        channel: the channel.
        what: a message of it, as an error names it.
        least: fewest bytes of a message.
        places: (M,) distances from the end of bytes that are the same in every message.
        marks: (M,) those bytes.
        distances: (R,) of each value.
        width: bytes of a value.
    """

    channel: Channel
    what: str
    least: int
    places: Places
    marks: ByteArray
    distances: Places
    width: int

    def checked_ends(self, path: Place, segment: Segment, table: MessageTable) -> Places:
        """Place after each message of the channel in its chunk, (n,), if all are laid out so.

        Raises:
            LogDamagedError: one is not.
        """
        ends = table.at + table.size
        if (table.size < self.least).any():
            wrong = "shorter than"
        elif (table.data[ends[:, None] - self.places] != self.marks).any():
            wrong = "laid out unlike"
        else:
            return ends
        raise LogDamagedError(f"{path}: {segment.name}: {self.what} is {wrong} the others")


@dataclass(frozen=True, slots=True)
class ScannedChunk:
    """A chunk whose messages are laid out as they should.

    Attributes:
        buffer: (>= B,) uint8, its records first.
        ends: (C, n) place after each message of each channel wanted.
        times: (C, n) its log time.
    """

    buffer: ByteArray
    ends: Places
    times: NDArray[np.uint64]


class ChunkScanner:
    """Decodes the chunks of one file for the channels of a view, laid out as they are."""

    def __init__(self, reader: LogReader, layouts: Sequence[RowLayout]) -> None:
        self._reader = reader
        self._layouts = layouts
        longest = max(len(layout.marks) for layout in layouts)
        places = np.zeros((len(layouts), longest), np.int64)
        marks = np.zeros((len(layouts), longest), np.uint8)
        for c, layout in enumerate(layouts):
            places[c, : len(layout.marks)] = layout.places
            marks[c, : len(layout.marks)] = layout.marks
        channels, least = [x.channel.id for x in layouts], [x.least for x in layouts]
        self._wanted = kernels.layouts(channels, least, places, marks)
        self._kept: tuple[int, ScannedChunk] | None = None
        self._tabled: set[int] = set()

    def chunk(self, segment: Segment) -> ScannedChunk:
        """Decode and check a chunk.

        What it gives is good until another chunk is asked for: fewer buffers stay in the CPU's
        cache, and frames are read in the order of the file.

        Raises:
            LogDamagedError: it is damaged, or a message of the view is not laid out like others.
        """
        key, kept = segment.offset, self._kept
        if kept is not None and kept[0] == key:
            return kept[1]
        self._kept = None
        buffer = np.empty(0, np.uint8) if kept is None else kept[1].buffer
        found = None if key in self._tabled else self.scanned(segment, buffer)
        if found is None:
            found = self.tabled(segment, buffer)
            self._tabled.add(key)
        self._kept = key, found
        return found

    def copy(self, chunk: ScannedChunk, which: int, low: int, out: NDArray[Any]) -> None:
        """Copy the values of a channel's messages from the `low`th of a chunk on, as bytes.

        Args:
            chunk: as it was decoded.
            which: the channel, a place in the layouts.
            low: the first message.
            out: (n, bytes of a message's values), written.
        """
        layout = self._layouts[which]
        ends = chunk.ends[which, low : low + len(out)]
        kernels.gather(chunk.buffer, ends, layout.distances, layout.width, out)

    def scanned(self, segment: Segment, buffer: ByteArray) -> ScannedChunk | None:
        """Decode a chunk by a kernel, into a buffer where it is large enough.

        Returns:
            None where the chunk is not in order, or not written as our recorder does it.
        """
        size, counts = segment.size, segment.channel_counts()
        if counts is None or segment.cut or not segment.indexes or not 0 < size <= MAX_CHUNK:
            return None
        buffer = _fitting(buffer, size)
        data = buffer[:size]
        try:
            index = self._reader.unpack(segment, data)
        except MalformedRecord:
            return None
        wanted = [counts.get(layout.channel.id, 0) for layout in self._layouts]
        found = kernels.scan(data, index, segment.start, segment.end, self._wanted, wanted)
        return None if found is None else ScannedChunk(buffer, *found)

    def tabled(self, segment: Segment, buffer: ByteArray) -> ScannedChunk:
        """Decode a chunk by its tables, into a buffer where it is large enough."""
        tables = [own_messages(self._reader, segment, layout.channel) for layout in self._layouts]
        ends = np.zeros((len(tables), max(map(len, tables))), np.int64)
        times = np.zeros(ends.shape, np.uint64)
        for which, (layout, table) in enumerate(zip(self._layouts, tables, strict=True)):
            ends[which, : len(table)] = layout.checked_ends(self._reader.path, segment, table)
            times[which, : len(table)] = table.log_time
        data = tables[0].data
        buffer = _fitting(buffer, len(data))
        buffer[: len(data)] = data
        return ScannedChunk(buffer, ends, times)


def _fitting(buffer: ByteArray, size: int) -> ByteArray:
    """A buffer where it is large enough, or else a new one with room for chunks that follow."""
    return buffer if len(buffer) >= size else np.empty(size + size // 8, np.uint8)
