"""Where the bytes of a log lie: a file, or what else can be read at any place."""

from __future__ import annotations

import os
import sys
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.untrusted import open_regular
from recorder.mcap.records import crc32

PARTIAL: Final = ".partial"
"""Ending of what is being written, or whose writing was cut short."""
OPEN_FILES = 24
"""Files of recordings that are open at once; a recording in parts has thousands."""

_PEEK: Final = 4096
_PEEK_FAR: Final = 256
"""Bytes read ahead at a place that is far from the last."""
_AHEAD: Final = 16 * 1024 * 1024
"""Most bytes of a file that are read ahead at once."""
_BLOCK: Final = 1024 * 1024
"""Bytes that a pass over a file reads at once."""


class Store:
    """`size` bytes of a file, read at any place, short pieces through one small window."""

    def __init__(self, path: Path, size: int) -> None:
        self.path, self.size = path, size
        self._window = b""
        self._window_at = 0

    def read_at(self, offset: int, count: int) -> bytes:
        """Return up to `count` bytes from `offset` on; none where the file ends by now.

        Raises:
            LogDamagedError: they cannot be read.
        """
        raise NotImplementedError

    def close(self) -> None:
        """Close it; harmless when called twice."""

    def expect(self, spans: Sequence[tuple[int, int]]) -> None:
        """Announce the ranges [start, stop) that will be read, one after the other."""

    def changed(self) -> bool:
        """Return whether it was written to since it was opened, other than by its recorder."""
        return False

    def peek(self, offset: int, count: int) -> bytes:
        """Up to `count` (few) bytes, read ahead for the peeks that follow."""
        at = offset - self._window_at
        if at < 0 or at + count > len(self._window):
            near = 0 <= at - len(self._window) < _PEEK_FAR
            self._window = self.read(offset, max(count, _PEEK if near else _PEEK_FAR))
            self._window_at, at = offset, 0
        return self._window[at : at + count]

    def read(self, offset: int, count: int) -> bytes:
        """`count` bytes, fewer only where the `size` bytes end.

        Raises:
            LogDamagedError: they cannot be read, or are not there any more.
        """
        count = max(min(count, self.size - offset), 0)
        parts: list[bytes] = []
        while count:
            part = self.read_at(offset, count)
            if not part:
                raise self._was_cut()
            parts.append(part)
            offset, count = offset + len(part), count - len(part)
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def read_into(self, offset: int, out: memoryview) -> int:
        """Fill memory with the bytes from `offset` on; how many, fewer only at the end.

        Raises:
            LogDamagedError: they cannot be read, or are not there any more.
        """
        data = self.read(offset, len(out))
        out[: len(data)] = data
        return len(data)

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

    def _was_cut(self) -> LogDamagedError:
        return LogDamagedError(f"{self.path}: it was cut while it was read")


class FileStore(Store):
    """A local file, closed and reopened when many others are open."""

    def __init__(self, path: Path) -> None:
        """Open the file.

        Raises:
            UsageError: it cannot be opened.
        """
        self._closed = False
        try:
            file = _Descriptor(path)
            self._seen = os.fstat(file.number)
        except OSError as error:
            raise UsageError(f"{path}: {error.strerror}") from None
        super().__init__(path, self._seen.st_size)
        self._keep(file)

    def read_at(self, offset: int, count: int) -> bytes:
        file = self._open()
        try:
            return os.pread(file.number, min(count, 1 << 30), offset)
        except OSError as error:
            raise LogDamagedError(f"{self.path}: {error.strerror}") from None

    def read_into(self, offset: int, out: memoryview) -> int:
        file, done = self._open(), 0
        most = max(min(len(out), self.size - offset), 0)
        try:
            while done < most and (n := os.preadv(file.number, [out[done:most]], offset + done)):
                done += n
        except OSError as error:
            raise LogDamagedError(f"{self.path}: {error.strerror}") from None
        if done < most:
            raise self._was_cut()
        return done

    def expect(self, spans: Sequence[tuple[int, int]]) -> None:
        """Let the system read spans, if they are few bytes, all at once and not one by one."""
        if sys.platform == "linux" and sum(stop - start for start, stop in spans) <= _AHEAD:
            number = self._open().number
            begin = end = 0
            for start, stop in (*spans, (-1, -1)):
                if start != end:  # spans that touch are one call
                    if begin < end:
                        os.posix_fadvise(number, begin, end - begin, os.POSIX_FADV_WILLNEED)
                    begin = start
                end = stop

    def changed(self) -> bool:
        with _LOCK:
            file = _OPEN.get(self)
        try:
            now = os.stat(self.path) if file is None else os.fstat(file.number)
        except OSError as error:
            raise LogDamagedError(f"{self.path}: {error.strerror}") from None
        return not self._is(now)

    def close(self) -> None:
        self._closed = True
        with _LOCK:
            _OPEN.pop(self, None)

    def _open(self) -> _Descriptor:
        if self._closed:
            raise ValueError(f"{self.path} is closed")
        with _LOCK:
            file = _OPEN.get(self)
            if file is not None:
                _OPEN.move_to_end(self)
                return file
        return self._opened_again()

    def _opened_again(self) -> _Descriptor:
        """Open the very file that was opened before."""
        try:
            if self._is(os.stat(self.path)):  # else it may be no file any more
                file = _Descriptor(self.path)
                if self._is(os.fstat(file.number)):
                    self._keep(file)
                    return file
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

    def _keep(self, file: _Descriptor) -> None:
        """Hold a file open, and close others."""
        with _LOCK:
            _OPEN[self] = file
            for one in [f for f in _OPEN if f is not self][: max(len(_OPEN) - OPEN_FILES, 0)]:
                _OPEN.pop(one)


class _Descriptor:
    """An open file; closed once nobody reads from it."""

    number = -1

    def __init__(self, path: Path) -> None:
        self.number = open_regular(path)

    def __del__(self, close: Callable[[int], None] = os.close) -> None:
        if self.number >= 0:
            close(self.number)


_LOCK: Final = threading.RLock()
_OPEN: Final[OrderedDict[FileStore, _Descriptor]] = OrderedDict()


class OnePass(Store):
    """A log that is read forwards, each byte once, with the checksum of what was passed.

    From `start` on a window of the file moves with the reads that begin in it. What is before or
    behind it is read apart. A small file is one window from the beginning.
    """

    def __init__(self, store: Store) -> None:
        super().__init__(store.path, store.size)
        self._store, self._end = store, store.size
        self._passed_crc = 0
        self._window_at = -1
        if self.size <= _BLOCK:
            self._window, self._window_at = store.read(0, self.size), 0

    def start(self, end: int) -> None:
        """Begin at the first byte, and read ahead no further than a place."""
        self._end = end
        if len(self._window) < self.size:
            self._window, self._window_at, self._passed_crc = b"", 0, 0

    def read_at(self, offset: int, count: int) -> bytes:
        if not self._reaches(offset):
            return self._store.read_at(offset, count)
        at = offset - self._window_at
        if at + count > len(self._window):
            self._pass(at)
            self._read_on(count)
            at = 0
        return self._window[at : at + count]

    def peek(self, offset: int, count: int) -> bytes:
        if self._window_at < 0:
            return self._store.peek(offset, count)
        return self.read(offset, count)

    def read_into(self, offset: int, out: memoryview) -> int:
        held = self._window[offset - self._window_at :] if self._reaches(offset) else b""
        if not self._reaches(offset) or len(out) - len(held) < _BLOCK:
            return super().read_into(offset, out)
        # What is left, which may be large, goes through no window.
        out[: len(held)] = held
        rest = self._store.read_into(offset + len(held), out[len(held) :])
        self._pass(len(self._window))
        self._passed_crc = crc32(out[len(held) : len(held) + rest], self._passed_crc)
        self._window_at += rest
        return len(held) + rest

    def pass_to(self, place: int) -> None:
        """Read on to a place."""
        while self._window_at + len(self._window) < min(place, self.size):
            self._pass(len(self._window))
            self._read_on(0)

    def crc_to(self, place: int) -> int:
        """Read on to a place that is not before the window; return the CRC-32 of all before it."""
        self.pass_to(place)
        return crc32(memoryview(self._window)[: place - self._window_at], self._passed_crc)

    def close(self) -> None:
        self._store.close()

    def _reaches(self, offset: int) -> bool:
        """Return whether a place is in the window, or at its end."""
        return 0 <= self._window_at <= offset <= self._window_at + len(self._window)

    def _pass(self, count: int) -> None:
        """Drop the first bytes of the window."""
        self._passed_crc = crc32(memoryview(self._window)[:count], self._passed_crc)
        self._window, self._window_at = self._window[count:], self._window_at + count

    def _read_on(self, count: int) -> None:
        """Lengthen the window, to `count` bytes at least."""
        end = self._window_at + len(self._window)
        ahead = min(_BLOCK, max(self._end - end, 0))
        self._window += self._store.read(end, max(count - len(self._window), ahead, 1))
