"""Where the bytes of a log lie: a file, or what else can be read at any place."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from cdmisfa.core.errors import LogDamagedError, UsageError
from replay.storage.checksum import crc32
from replay.storage.location import Location

_PEEK: Final = 4096


class Store(ABC):
    """`size` bytes at a path or URL, read at any place, short pieces through one small window."""

    size: int

    def __init__(self, path: Location) -> None:
        self.path = path
        self._window = b""
        self._window_at = 0

    @abstractmethod
    def read_at(self, offset: int, count: int) -> bytes:
        """Up to `count` bytes from `offset` on; none at the end.

        Raises:
            LogDamagedError: they cannot be read.
        """

    @abstractmethod
    def close(self) -> None:
        """Let go; harmless when called twice."""

    def expect(self, spans: Sequence[tuple[int, int]]) -> None:  # noqa: B027 - a hint
        """Hear which spans [start, stop) will be read, one after the other."""

    def grow(self) -> bool:
        """Look at the size again; whether it grew."""
        return False

    def is_at(self, path: Path) -> bool:
        """Whether a path leads to the very file that was opened."""
        return False

    def peek(self, offset: int, count: int) -> bytes:
        """Up to `count` (few) bytes, read ahead for the peeks that follow."""
        at = offset - self._window_at
        if at < 0 or at + count > len(self._window):
            self._window = self.read(offset, max(count, _PEEK))
            self._window_at, at = offset, 0
        return self._window[at : at + count]

    def read(self, offset: int, count: int) -> bytes:
        """`count` bytes, fewer only where the file ends."""
        count = max(min(count, self.size - offset), 0)
        parts: list[bytes] = []
        while count and (part := self.read_at(offset, count)):
            parts.append(part)
            offset, count = offset + len(part), count - len(part)
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def blocks(self, offset: int, stop: int) -> Iterator[bytes]:
        """Give the bytes [offset, stop), 1 MiB at a time."""
        while offset < stop and (part := self.read(offset, min(1 << 20, stop - offset))):
            yield part
            offset += len(part)

    def crc(self, offset: int, stop: int) -> int:
        """CRC-32 of the bytes [offset, stop)."""
        value = 0
        for block in self.blocks(offset, stop):
            value = crc32(block, value)
        return value


class FileStore(Store):
    """A file of this machine."""

    def __init__(self, path: Path) -> None:
        """Open the file.

        Raises:
            UsageError: it cannot be opened.
        """
        super().__init__(path)
        try:
            self._fd: int | None = os.open(path, os.O_RDONLY)
            self.size = os.fstat(self._fd).st_size
        except OSError as error:
            raise UsageError(f"{path}: {error.strerror}") from None
        if not path.is_file():
            self.close()
            raise UsageError(f"{path}: not a file")

    def read_at(self, offset: int, count: int) -> bytes:
        try:
            return os.pread(self._descriptor(), min(count, 1 << 30), offset)
        except OSError as error:
            raise LogDamagedError(f"{self.path}: {error.strerror}") from None

    def is_at(self, path: Path) -> bool:
        try:
            return os.path.samestat(os.stat(path), os.fstat(self._descriptor()))
        except OSError:
            return False

    def grow(self) -> bool:
        before, self.size = self.size, os.fstat(self._descriptor()).st_size
        self._window = b""
        return self.size > before

    def close(self) -> None:
        if self._fd is not None:
            os.close(self._fd)
            self._fd = None

    def _descriptor(self) -> int:
        if self._fd is None:
            raise ValueError(f"{self.path} is closed")
        return self._fd
