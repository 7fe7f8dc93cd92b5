"""Access to the bytes of a log."""

from __future__ import annotations

import contextlib
import os
import resource
import sys
import weakref
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from cdmisfa.core.errors import LogDamagedError
from cdmisfa.core.untrusted import file_number
from recorder.mcap.records import crc32

# Ending of the name of a file that is being written, or whose writing was interrupted.
PARTIAL: Final = ".partial"

# Bytes read ahead for short reads: near the previous read, and far from it.
_PEEK: Final = 4096
_PEEK_FAR: Final = 256
# Largest size that the operating system is asked to read ahead at once (bytes).
_AHEAD: Final = 16 * 1024 * 1024
# Bytes that a pass over a file reads at once, so many that system calls take no time.
_BLOCK: Final = 1024 * 1024


def allow_many_files() -> None:
    """Raise the soft limit of open files: a recording in parts, or of many views, has thousands."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.suppress(ValueError, OSError):  # systems that have no largest number
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


allow_many_files()


class Store:
    """A local file that is read at any offset; short reads share one small window."""

    def __init__(self, path: Path) -> None:
        """Open the file.

        Raises:
            UsageError: the file cannot be opened.
        """
        number = file_number(path)
        self._status = os.fstat(number)
        self.path, self.size = path, self._status.st_size
        self._window, self._window_at = b"", 0
        self._reads: dict[int, bytes] | None = None
        # The finalizer also closes the file if nobody calls `close`.
        self._number, self._release = number, weakref.finalize(self, os.close, number)

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
        data = parts[0] if len(parts) == 1 else b"".join(parts)
        if self._reads is not None and len(data) > _PEEK:
            self._reads[offset - len(data)] = data
        return data

    def keep_reads(self) -> None:
        """Keep the bytes read until the next call of `crc`, so that a pass reads each byte once."""
        self._reads = {}

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

    def crc(self, offset: int, stop: int, value: int = 0) -> int:
        """Return the CRC-32 of the bytes [offset, stop) behind bytes with the CRC-32 `value`."""
        reads, self._reads = self._reads, None
        for start, data in sorted((reads or {}).items()):
            if offset <= start and start + len(data) <= stop:
                for block in self.blocks(offset, start):
                    value = crc32(block, value)
                value, offset = crc32(data, value), start + len(data)
        for block in self.blocks(offset, stop):
            value = crc32(block, value)
        self._reads = None if reads is None else {}
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
            now = os.stat(self._number if self._release.alive else self.path)
        except OSError as error:
            raise LogDamagedError(f"{self.path}: {error.strerror}") from None
        if self.path.suffix == PARTIAL:  # a log being written can grow
            same = now.st_size >= self.size
        else:
            same = (now.st_size, now.st_mtime_ns) == (self.size, self._status.st_mtime_ns)
        return not (same and os.path.samestat(now, self._status))

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        self._release()

    @contextlib.contextmanager
    def _opened(self) -> Iterator[int]:
        """Yield the descriptor of the file, and report an error of the system as damage."""
        if not self._release.alive:
            raise ValueError(f"{self.path} is closed")
        try:
            yield self._number
        except OSError as error:
            raise LogDamagedError(f"{self.path}: {error.strerror} while it was read") from None
