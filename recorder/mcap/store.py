"""Read the bytes of a log at any place, or all of them once."""

from __future__ import annotations

import contextlib
import os
import sys
import weakref
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.untrusted import open_regular
from recorder.mcap.records import crc32

# Ending of a file that is being written, or whose writing was cut short.
PARTIAL: Final = ".partial"

# Files of recordings that stay open at once; a recording in parts has thousands, and a process may
# have 256 files open on some systems.
OPEN_FILES = 24

# Bytes read ahead for short reads: where they follow one another, and at a place far from the last.
_PEEK: Final = 4096
_PEEK_FAR: Final = 256
# Most bytes of a file that the system is asked to read ahead at once.
_AHEAD: Final = 16 * 1024 * 1024
# Bytes that a pass over a file reads at once: large enough that system calls take no time.
_BLOCK: Final = 1024 * 1024


class Store:
    """A local file, read at any place, short pieces through one small window.

    The first `OPEN_FILES` stay open, further ones are opened for each read.
    """

    def __init__(self, path: Path) -> None:
        """Open the file.

        Raises:
            UsageError: it cannot be opened.
        """
        try:
            number = open_regular(path)
            self._seen = os.fstat(number)
        except OSError as error:
            raise UsageError(f"{path}: {error.strerror}") from None
        self.path, self.size = path, self._seen.st_size
        self._window, self._window_at = b"", 0
        self._closed = False
        # Closes it also where nobody calls `close`.
        self._number, self._release = number, weakref.finalize(self, os.close, number)
        if len(_STAY_OPEN) < OPEN_FILES:
            _STAY_OPEN.add(self)
        else:
            self._release()

    def read_at(self, offset: int, count: int) -> bytes:
        """Return up to `count` bytes from `offset` on; none where the file ends by now.

        Raises:
            LogDamagedError: they cannot be read.
        """
        with self._opened() as number:
            return os.pread(number, min(count, 1 << 30), offset)

    def read(self, offset: int, count: int) -> bytes:
        """Return `count` bytes, fewer only where the `size` bytes end.

        Raises:
            LogDamagedError: they cannot be read, or are not there any more.
        """
        count = max(min(count, self.size - offset), 0)
        parts: list[bytes] = []
        while count:
            part = self.read_at(offset, count)
            if not part:
                raise LogDamagedError(f"{self.path}: it was cut while it was read")
            parts.append(part)
            offset, count = offset + len(part), count - len(part)
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def peek(self, offset: int, count: int) -> bytes:
        """Return up to `count` (few) bytes, and read ahead for the peeks that follow."""
        at = offset - self._window_at
        if at < 0 or at + count > len(self._window):
            near = 0 <= at - len(self._window) < _PEEK_FAR
            self._window = self.read(offset, max(count, _PEEK if near else _PEEK_FAR))
            self._window_at, at = offset, 0
        return self._window[at : at + count]

    def blocks(self, offset: int, stop: int) -> Iterator[bytes]:
        """Yield the bytes [offset, stop), 1 MiB at a time."""
        while offset < stop and (part := self.read(offset, min(_BLOCK, stop - offset))):
            yield part
            offset += len(part)

    def crc(self, offset: int, stop: int) -> int:
        """Return the CRC-32 of the bytes [offset, stop)."""
        value = 0
        for block in self.blocks(offset, stop):
            value = crc32(block, value)
        return value

    def expect(self, spans: Sequence[tuple[int, int]]) -> None:
        """Let the system read the ranges [start, stop) at once, if they are few bytes."""
        if sys.platform == "linux" and sum(stop - start for start, stop in spans) <= _AHEAD:
            with self._opened() as number:
                begin = end = 0
                for start, stop in (*spans, (-1, -1)):
                    if start != end:  # spans that touch are one call
                        if begin < end:
                            os.posix_fadvise(number, begin, end - begin, os.POSIX_FADV_WILLNEED)
                        begin = start
                    end = stop

    def changed(self) -> bool:
        """Return whether it was written to since it was opened, other than by its recorder."""
        try:
            now = os.fstat(self._number) if self._release.alive else os.stat(self.path)
        except OSError as error:
            raise LogDamagedError(f"{self.path}: {error.strerror}") from None
        return not self._is(now)

    def close(self) -> None:
        """Close it; harmless when called twice."""
        self._closed = True
        _STAY_OPEN.discard(self)
        self._release()

    @contextlib.contextmanager
    def _opened(self) -> Iterator[int]:
        """Yield the number of the open file, the very file that was opened first."""
        if self._closed:
            raise ValueError(f"{self.path} is closed")
        try:
            if self._release.alive:
                yield self._number
                return
            if self._is(os.stat(self.path)):  # else it may be no file any more
                number = open_regular(self.path)
                try:
                    if self._is(os.fstat(number)):
                        yield number
                        return
                finally:
                    os.close(number)
        except OSError as error:
            raise LogDamagedError(f"{self.path}: {error.strerror} while it was read") from None
        raise LogDamagedError(f"{self.path}: it was replaced while it was read")

    def _is(self, now: os.stat_result) -> bool:
        """Return whether a file is the one that was opened; one being recorded may be longer."""
        if self.path.suffix == PARTIAL:
            same = now.st_size >= self.size
        else:
            same = (now.st_size, now.st_mtime_ns) == (self.size, self._seen.st_mtime_ns)
        return same and os.path.samestat(now, self._seen)


_STAY_OPEN: Final[weakref.WeakSet[Store]] = weakref.WeakSet()


class OnePass(Store):
    """A log that is read forwards, each byte once, with the checksum of the bytes passed.

    From `start` on a window of the file moves with the reads that begin in it; reads before or
    behind it go to the file. A small file is one window from the beginning.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._end = self.size
        self._passed_crc = 0
        self._ahead, self._ahead_at = b"", -1
        if self.size <= _BLOCK:
            self._ahead, self._ahead_at = self.read(0, self.size), 0

    def start(self, end: int) -> None:
        """Begin at the first byte, and read ahead no further than a place."""
        self._end = end
        if len(self._ahead) < self.size:
            self._ahead, self._ahead_at, self._passed_crc = b"", 0, 0

    def read_at(self, offset: int, count: int) -> bytes:
        at = offset - self._ahead_at
        if self._ahead_at < 0 or not 0 <= at <= len(self._ahead):
            return super().read_at(offset, count)
        if at + count > len(self._ahead):
            self._pass(at)
            if count - len(self._ahead) >= _BLOCK:  # a large chunk goes through no window
                rest = offset + len(self._ahead), count - len(self._ahead)
                self._ahead = data = self._ahead + super().read_at(*rest)
                self._pass(len(data))
                return data
            self._read_on(count)
            at = 0
        return self._ahead[at : at + count]

    def peek(self, offset: int, count: int) -> bytes:
        return super().peek(offset, count) if self._ahead_at < 0 else self.read(offset, count)

    def pass_to(self, place: int) -> None:
        """Read on to a place."""
        while self._ahead_at + len(self._ahead) < min(place, self.size):
            self._pass(len(self._ahead))
            self._read_on(0)

    def crc_to(self, place: int) -> int:
        """Read on to a place that is not before the window; return the CRC-32 of all before it."""
        self.pass_to(place)
        return crc32(memoryview(self._ahead)[: place - self._ahead_at], self._passed_crc)

    def _pass(self, count: int) -> None:
        """Drop the first bytes of the window."""
        self._passed_crc = crc32(memoryview(self._ahead)[:count], self._passed_crc)
        self._ahead, self._ahead_at = self._ahead[count:], self._ahead_at + count

    def _read_on(self, count: int) -> None:
        """Lengthen the window, to `count` bytes at least."""
        end = self._ahead_at + len(self._ahead)
        ahead = min(_BLOCK, max(self._end - end, 0))
        more = max(count - len(self._ahead), ahead, 1)
        part = super().read_at(end, min(more, self.size - end))
        if not part and end < self.size:
            raise LogDamagedError(f"{self.path}: it was cut while it was read")
        self._ahead += part
