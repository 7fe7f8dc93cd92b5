"""Chunks of a recording whose messages all look alike, decoded into memory that is used again."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import zstandard
from numpy.typing import NDArray

from replay.mcap.reader import LogReader
from replay.mcap.records import MAX_CHUNK, Bytes, MalformedRecord, decompress
from replay.mcap.segments import Segment
from replay.storage.checksum import crc32

_KEPT: Final = 2
_WINDOW: Final = MAX_CHUNK // 2


@dataclass(frozen=True, slots=True)
class RowLayout:
    """Where the messages of a channel hold their values, counted from a message's end.

    Attributes:
        channel: its number.
        least: fewest bytes of a message.
        marks: distance from the end -> byte that must stand there.
        distances: (R,) of each value.
        width: bytes of a value.
    """

    channel: int
    least: int
    marks: Sequence[tuple[int, int]]
    distances: NDArray[np.int64]
    width: int


@dataclass(frozen=True, slots=True)
class ScannedChunk:
    """A chunk that was found in order.

    Attributes:
        buffer: (>= B,) uint8, its records first.
        ends: (C, n) place after each message of each channel wanted.
    """

    buffer: Bytes
    ends: NDArray[np.int64]


class ChunkScanner:
    """Decodes the chunks of one file for the channels of a view.

    Args:
        reader: the file.
        layouts: of the channels wanted.
    """

    def __init__(self, reader: LogReader, layouts: Sequence[RowLayout]) -> None:
        # Imported with the first block that is read, so that looking at a log compiles nothing.
        from replay.recordings import kernels as scan

        self._scan, self._gather = scan.scan, scan.gather
        self._reader = reader
        self._layouts = layouts
        longest = max(len(layout.marks) for layout in layouts)
        self._channels = np.array([layout.channel for layout in layouts], np.int64)
        self._least = np.array([layout.least for layout in layouts], np.int64)
        self._places = np.zeros((len(layouts), longest), np.int64)
        self._marks = np.zeros((len(layouts), longest), np.uint8)
        for c, layout in enumerate(layouts):
            for k, (distance, byte) in enumerate(layout.marks):
                self._places[c, k], self._marks[c, k] = distance, byte
        self._zstd = zstandard.ZstdDecompressor(max_window_size=_WINDOW)
        self._kept: OrderedDict[int, ScannedChunk | None] = OrderedDict()

    def chunk(self, segment: Segment) -> ScannedChunk | None:
        """Decode and check a chunk; None where it is not in order or not written as we do it.

        What it gives is good until two other chunks are asked for.
        """
        key = segment.offset
        if key in self._kept:
            return self._kept[key]
        buffer = np.empty(0, np.uint8)
        if len(self._kept) >= _KEPT:
            _, old = self._kept.popitem(last=False)
            buffer = buffer if old is None else old.buffer
        self._kept[key] = found = self._decode(segment, buffer)
        return found

    def copy(self, chunk: ScannedChunk, which: int, low: int, out: NDArray[Any]) -> None:
        """Copy the values of a channel's messages from the `low`th of a chunk on, as bytes."""
        layout = self._layouts[which]
        ends = chunk.ends[which, low : low + len(out)]
        self._gather(chunk.buffer, ends, layout.distances, layout.width, out)

    def _decode(self, segment: Segment, buffer: Bytes) -> ScannedChunk | None:
        size, counts = segment.size, segment.channel_counts()
        if counts is None or segment.cut or not segment.indexes or not 0 < size <= MAX_CHUNK:
            return None
        if len(buffer) < size:
            buffer = np.empty(size + size // 8, np.uint8)
        try:
            stored, index = self._reader.stored(segment)
            if not self._decompress(stored, segment, buffer):
                return None
        except (MalformedRecord, zstandard.ZstdError):
            return None
        data = buffer[:size]
        if segment.crc and crc32(data.data) != segment.crc:
            return None
        wanted = [counts.get(layout.channel, 0) for layout in self._layouts]
        ends = np.empty((len(wanted), max(wanted)), np.int64)
        if max(segment.start, segment.end) >= 2**63 or not self._scan(
            data,
            np.frombuffer(index, np.uint8),
            segment.start,
            segment.end,
            self._channels,
            self._least,
            self._places,
            self._marks,
            ends,
            np.array(wanted, np.int64),
        ):
            return None
        return ScannedChunk(buffer, ends)

    def _decompress(self, stored: memoryview, segment: Segment, buffer: Bytes) -> bool:
        size = segment.size
        if segment.compression != "zstd":
            raw = decompress(bytes(stored), segment.compression, size)
            buffer[:size] = np.frombuffer(raw, np.uint8)
            return True
        if zstandard.frame_content_size(stored) != size:
            return False
        # Where the whole output fits, zstd writes straight into it.
        return bool(self._zstd.stream_reader(stored).readinto(buffer[:size].data) == size)
