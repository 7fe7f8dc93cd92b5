"""The checksum over all of a log's data, checked once, wherever all of it is read."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from typing import Final

from recorder.mcap.records import RECORD_HEADER, Segment, crc32
from recorder.mcap.store import Store
from recorder.mcap.walk import LogStructure

_CHUNK_HEADER: Final = 256


class DataSection:
    """The bytes of a log before its data's end record.

    Args:
        file: the log; an attribute, too.
        structure: of the log.
        damaged: called where the checksum does not match.
    """

    def __init__(self, file: Store, structure: LogStructure, damaged: Callable[[], None]) -> None:
        self.file = file
        self._structure = structure
        self._damaged = damaged
        self._checked = 0

    def check(self, crc: int | None = None) -> None:
        """Compare the checksum that the log states with that of its data, once.

        Args:
            crc: of its data, where that was read; by default it is read now.
        """
        stated, end = self._structure.data_crc, self._structure.data_end
        if not stated or self._checked == end:
            return
        self._checked = end
        if (self.file.crc(0, end) if crc is None else crc) != stated:
            self._damaged()

    def check_unproven(self) -> None:
        """Check it for a chunk that has no checksum of its own."""
        if self._structure.by_index:
            self.check()

    def unprotected(self, segments: Sequence[Segment]) -> int:
        """Count the segments that no checksum protects.

        Of a file opened by its index, which states none, the first chunk stands for all.
        """
        if self._structure.data_crc:
            return 0
        if self._structure.by_index:
            places = [s.offset + RECORD_HEADER.size for s in segments[:1]]
            segments = [Segment.of_chunk(p, self.file.peek(p, _CHUNK_HEADER)) for p in places]
        return sum(1 for s in segments if s.crc == 0 and s.size)

    def sha256(self, counted: Callable[[int], None] = lambda count: None) -> str:
        """Return the SHA-256 of the file, whose checksum is checked on the way.

        Args:
            counted: called with the number of each further bytes that were hashed.
        """
        sha256, crc, at = hashlib.sha256(), 0, 0
        end = self._structure.data_end if self._structure.data_crc else 0
        for block in self.file.blocks(0, self.file.size):
            sha256.update(block)
            crc = crc32(block[: max(end - at, 0)], crc)
            at += len(block)
            counted(len(block))
        self.check(crc)
        return sha256.hexdigest()

    def changed(self) -> bool:
        """Whether the file may hold something else than when it was opened."""
        return self.file.changed()

    def read(self, offset: int, count: int) -> bytes:
        """`count` bytes of the file, fewer only where it ends."""
        return self.file.read(offset, count)

    def tail(self) -> Iterator[bytes]:
        """The bytes from its data end record on, where the file was opened by its index."""
        if self._structure.by_index:
            yield from self.file.blocks(self._structure.data_end, self.file.size)
