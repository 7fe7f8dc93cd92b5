"""Access to the bytes of a log: `Store` at any offset, `OnePass` once from begin to end."""

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

# Ending of the name of a file that is being written, or whose writing was interrupted.
PARTIAL: Final = ".partial"

# Largest number of files of recordings that stay open. A recording in parts has thousands, and some
# systems allow 256 open files for a process.
OPEN_FILES = 24

# Bytes read ahead for short reads: near the previous read, and far from it.
_PEEK: Final = 4096
_PEEK_FAR: Final = 256
# Largest size that the operating system is asked to read ahead at once (bytes).
_AHEAD: Final = 16 * 1024 * 1024
# Bytes that a pass over a file reads at once, so many that system calls take no time.
_BLOCK: Final = 1024 * 1024


class Store:
    """A local file that is read at any offset; short reads share one small window.

    The first `OPEN_FILES` files stay open, further ones are opened for each read.
    """

    def __init__(self, path: Path) -> None:
        """Open the file.

        Raises:
            UsageError: the file cannot be opened.
        """
        try:
            number = open_regular(path)
            self._status = os.fstat(number)
        except OSError as error:
            raise UsageError(f"{path}: {error.strerror}") from None
        self.path, self.size = path, self._status.st_size
        self._window, self._window_at = b"", 0
        self._closed = False
        # The finalizer also closes the file if nobody calls `close`.
        self._number, self._release = number, weakref.finalize(self, os.close, number)
        if len(_STAY_OPEN) < OPEN_FILES:
            _STAY_OPEN.add(self)
        else:
            self._release()

    def read_at(self, offset: int, count: int) -> bytes:
        """Return at most `count` bytes from `offset` on; none if the file ends before.

        Raises:
            LogDamagedError: the bytes cannot be read.
        """
        with self._opened() as number:
            return os.pread(number, min(count, 1 << 30), offset)

    def read(self, offset: int, count: int) -> bytes:
        """Return `count` bytes, or fewer at the end of the `size` bytes.

        Raises:
            LogDamagedError: the bytes cannot be read, or are no longer there.
        """
        count = max(min(count, self.size - offset), 0)
        parts: list[bytes] = []
        while count:
            part = self.read_at(offset, count)
            if not part:
                raise LogDamagedError(f"{self.path}: another program cut it while it was read")
            parts.append(part)
            offset, count = offset + len(part), count - len(part)
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def peek(self, offset: int, count: int) -> bytes:
        """Return at most `count` (few) bytes, and read ahead for further calls."""
        at = offset - self._window_at
        if at < 0 or at + count > len(self._window):
            near = 0 <= at - len(self._window) < _PEEK_FAR
            self._window = self.read(offset, max(count, _PEEK if near else _PEEK_FAR))
            self._window_at, at = offset, 0
        return self._window[at : at + count]

    def blocks(self, offset: int, stop: int) -> Iterator[bytes]:
        """Yield the bytes [offset, stop) in pieces of 1 MiB."""
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
        """Ask the system to read the ranges [start, stop) at once, if they are not too large."""
        if sys.platform == "linux" and sum(stop - start for start, stop in spans) <= _AHEAD:
            with self._opened() as number:
                begin = end = 0
                for start, stop in (*spans, (-1, -1)):
                    if start != end:  # adjacent ranges are joined to one call
                        if begin < end:
                            os.posix_fadvise(number, begin, end - begin, os.POSIX_FADV_WILLNEED)
                        begin = start
                    end = stop

    def changed(self) -> bool:
        """Return whether the file changed since it was opened, except by its recorder."""
        try:
            now = os.fstat(self._number) if self._release.alive else os.stat(self.path)
        except OSError as error:
            raise LogDamagedError(f"{self.path}: {error.strerror}") from None
        return not self._is(now)

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        self._closed = True
        _STAY_OPEN.discard(self)
        self._release()

    @contextlib.contextmanager
    def _opened(self) -> Iterator[int]:
        """Yield the descriptor of the file, which must be the file that was opened first."""
        if self._closed:
            raise ValueError(f"{self.path} is closed")
        try:
            if self._release.alive:
                yield self._number
                return
            if self._is(os.stat(self.path)):  # before opening: it may be a device by now
                number = open_regular(self.path)
                try:
                    if self._is(os.fstat(number)):
                        yield number
                        return
                finally:
                    os.close(number)
        except OSError as error:
            raise LogDamagedError(f"{self.path}: {error.strerror} while it was read") from None
        raise LogDamagedError(f"{self.path}: another program replaced it while it was read")

    def _is(self, now: os.stat_result) -> bool:
        """Return whether a status is that of the opened file; a log being written can grow."""
        if self.path.suffix == PARTIAL:
            same = now.st_size >= self.size
        else:
            same = (now.st_size, now.st_mtime_ns) == (self.size, self._status.st_mtime_ns)
        return same and os.path.samestat(now, self._status)


_STAY_OPEN: Final[weakref.WeakSet[Store]] = weakref.WeakSet()


class OnePass(Store):
    """A log that is read forwards, each byte once, with the checksum of the bytes that were read.

    After `start` a window of the file moves with the reads that begin in it; other reads go to the
    file directly. A small file is one window from the beginning.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._end = self.size
        self._passed_crc = 0
        self._ahead, self._ahead_at = b"", -1
        if self.size <= _BLOCK:
            self._ahead, self._ahead_at = self.read(0, self.size), 0

    def start(self, end: int) -> None:
        """Move to the first byte, and read ahead at most up to `end`."""
        self._end = end
        if len(self._ahead) < self.size:
            self._ahead, self._ahead_at, self._passed_crc = b"", 0, 0

    def read_at(self, offset: int, count: int) -> bytes:
        at = offset - self._ahead_at
        if self._ahead_at < 0 or not 0 <= at <= len(self._ahead):
            return super().read_at(offset, count)
        if at + count > len(self._ahead):
            self._pass(at)
            if count - len(self._ahead) >= _BLOCK:  # read a large chunk without the window
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
        """Read on up to an offset."""
        while self._ahead_at + len(self._ahead) < min(place, self.size):
            self._pass(len(self._ahead))
            self._read_on(0)

    def crc_to(self, place: int) -> int:
        """Read on up to an offset in or after the window; return the CRC-32 of all bytes before."""
        self.pass_to(place)
        return crc32(memoryview(self._ahead)[: place - self._ahead_at], self._passed_crc)

    def _pass(self, count: int) -> None:
        """Drop the first bytes of the window."""
        self._passed_crc = crc32(memoryview(self._ahead)[:count], self._passed_crc)
        self._ahead, self._ahead_at = self._ahead[count:], self._ahead_at + count

    def _read_on(self, count: int) -> None:
        """Extend the window to at least `count` bytes."""
        end = self._ahead_at + len(self._ahead)
        ahead = min(_BLOCK, max(self._end - end, 0))
        more = max(count - len(self._ahead), ahead, 1)
        part = super().read_at(end, min(more, self.size - end))
        if not part and end < self.size:
            raise LogDamagedError(f"{self.path}: another program cut it while it was read")
        self._ahead += part
