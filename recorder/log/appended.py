"""Files that are only appended to, of which any number is written at the same time."""

from __future__ import annotations

import contextlib
import fcntl
import os
import threading
import weakref
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Final

from cdmisfa.core.errors import LogWriteError, UsageError

OPEN_FILES = 24
"""Files that are open at once; a recording has a file for each of its views."""


class AppendedFile:
    """A binary file that, once a write failed, refuses every later one.

    The MCAP writer would go on after a failed write, and the log would have a hole in it.

    Where many are written, those that were not written to for the longest are closed until they
    are again. An open one is kept from other processes; one that was closed is not, but what
    became of it meanwhile is noticed. Who writes many holds their folder, see `held`.
    """

    def __init__(self, path: Path) -> None:
        """Begin the file anew.

        Raises:
            UsageError: another process writes it.
            LogWriteError: it cannot be opened.
        """
        self._path = path
        self._error: LogWriteError | None = None
        self.closed = False
        try:
            self._file: BinaryIO | None = open(path, "ab")  # noqa: SIM115 - open until `close`
            try:
                self._hold(self._file)
                self._file.seek(0)
                self._seen = os.fstat(self._file.fileno())
                if self._seen.st_size:
                    self._file.truncate()
            except BaseException:
                self._file.close()
                raise
        except OSError as error:
            raise write_error(path, error) from error
        self._own = weakref.ref(self, lambda own: _OPEN.pop(own, None))
        with _LOCK:
            _close_others(self)

    def _hold(self, file: BinaryIO) -> None:
        """Keep other processes from writing the file while it is open."""
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if not isinstance(error, BlockingIOError):
                return  # a file system without locks: nothing can be held there
            raise self._in_use() from error
        there = os.fstat(file.fileno())
        if not (self._path.exists() and os.path.samestat(os.stat(self._path), there)):
            raise self._in_use()

    def _in_use(self) -> UsageError:
        return UsageError(
            f"{self._path} is being written by another process: wait for it, or choose another name"
        )

    def check(self) -> None:
        """Refuse to go on where something was not written, or nothing more is to be."""
        if self._error is not None:
            raise LogWriteError(str(self._error)) from self._error
        if self.closed:
            raise LogWriteError(f"{self._path}: this log is closed, nothing more can be written")

    def write(self, data: bytes) -> int:
        """Append all of the bytes."""
        with self._latching() as file:
            return file.write(data)

    def tell(self) -> int:
        """Bytes that were appended."""
        return self._seen.st_size if self._file is None else self._file.tell()

    def flush(self) -> None:
        """Hand everything to the operating system."""
        with self._latching() as file:
            file.flush()

    def sync(self) -> None:
        """Let the disk have everything."""
        with self._latching() as file:
            file.flush()
            os.fsync(file.fileno())

    def close(self) -> None:
        """Write nothing more."""
        self.closed = True
        with _LOCK:
            self.set_aside()

    def set_aside(self) -> None:
        """Close the file until it is written to again, or for good."""
        _OPEN.pop(self._own, None)
        file, self._file = self._file, None
        if file is None:
            return
        try:
            with contextlib.closing(file):
                file.flush()
                self._seen = os.fstat(file.fileno())
        except OSError as error:  # the first one counts: closing tries again what failed
            self._error = self._error or write_error(self._path, error)

    @contextlib.contextmanager
    def _latching(self) -> Iterator[BinaryIO]:
        self.check()
        with _LOCK:
            try:
                if self._file is None:
                    self._file = self._opened_again()
                _close_others(self)
                yield self._file
            except LogWriteError as error:
                self._error = error
                self.close()
                raise
            except OSError as error:
                self._error = write_error(self._path, error)
                self.close()
                raise self._error from error

    def _opened_again(self) -> BinaryIO:
        """Open the very file that was written before, where nobody else wrote to it."""
        path = self._path
        file = open(os.open(path, os.O_WRONLY | os.O_APPEND), "ab")  # noqa: SIM115
        try:
            self._hold(file)
            now = os.fstat(file.fileno())
            if not os.path.samestat(now, self._seen) or now.st_size != self._seen.st_size:
                raise self._in_use()
        except UsageError as error:
            file.close()
            raise LogWriteError(str(error)) from error
        except BaseException:
            file.close()
            raise
        return file


def write_error(path: Path, error: OSError) -> LogWriteError:
    """That a disk does not take a file."""
    return LogWriteError(
        f"{path} cannot be written: {error.strerror or error}; "
        "check the free space and rights there, what was flushed is readable"
    )


def _close_others(used: AppendedFile) -> None:
    """Note which file is used, and close those that were used the longest ago."""
    _OPEN[used._own] = None
    _OPEN.move_to_end(used._own)
    while len(_OPEN) > OPEN_FILES:
        own, _ = _OPEN.popitem(last=False)
        if (least := own()) is not None:
            least.set_aside()


_LOCK: Final = threading.RLock()
_OPEN: Final[OrderedDict[weakref.ref[AppendedFile], None]] = OrderedDict()
"""Open files, the one that was used last at the end; none that nobody has any more."""
