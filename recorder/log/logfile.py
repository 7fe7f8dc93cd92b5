"""Write an MCAP file that survives what happens to it.

A `LogFile` is `NAME.partial` until it is finished, so a file called NAME is always
whole. What was written is readable up to the last flush after any end: an error, a
signal, kill -9, a full disk; after a power cut up to the last `sync`.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO, Final, Self
from weakref import WeakSet

from cdmisfa.core.errors import LogWriteError, UsageError
from recorder.log.files import partial_path, refuse_taken, to_disk
from recorder.mcap.store import OPEN_FILES
from recorder.mcap.writer import McapWriter

# Log time after which the chunk in progress is handed to the operating system, by default.
#
# A run's log flushes by wall time (`replay/runs/writer.py`).
FLUSH_NS: Final = 1_000_000_000


class AppendOnlyFile:
    """A binary file that is only appended to and, once a write failed, refuses every later one.

    The MCAP writer would continue after a failed write, and the log would have a hole in it.

    The first `OPEN_FILES` that are written at the same time stay open, which locks them for other
    processes; further ones are opened for each write. A recorder of many files holds their folder.
    """

    def __init__(self, path: Path) -> None:
        """Begin an empty file.

        Raises:
            UsageError: another process writes it.
            LogWriteError: it cannot be opened.
        """
        self._path, self._size = path, 0
        self._error: LogWriteError | None = None
        self._file: BinaryIO | None = None
        self.closed = False
        with self._errors():
            file: BinaryIO = open(path, "ab")  # noqa: SIM115 - open until `close`
            try:
                self._lock(file)
                file.seek(0)
                if os.fstat(file.fileno()).st_size:  # a device, as /dev/full, cannot be truncated
                    file.truncate()
            except BaseException:
                file.close()
                raise
            if len(_STAY_OPEN) < OPEN_FILES:
                self._file = file
                _STAY_OPEN.add(self)
            else:
                file.close()

    def check(self) -> None:
        """Raise a LogWriteError if a write has failed, or the file is closed."""
        if self._error is not None:
            raise LogWriteError(str(self._error)) from self._error
        if self.closed:
            raise LogWriteError(f"{self._path}: this log is closed, nothing more can be written")

    def write(self, data: bytes | memoryview) -> int:
        """Append all of the bytes."""
        with self._opened() as file:
            self._size += file.write(data)
        return len(data)

    def tell(self) -> int:
        """Return the number of bytes that were appended."""
        return self._size

    def flush(self) -> None:
        """Hand everything to the operating system."""
        with self._opened() as file:
            file.flush()

    def sync(self) -> None:
        """Let the disk have everything."""
        with self._opened() as file:
            file.flush()
            os.fsync(file.fileno())

    def close(self) -> None:
        """Close the file; the error of an earlier write is kept, as closing repeats that write."""
        self.closed = True
        _STAY_OPEN.discard(self)
        file, self._file = self._file, None
        if file is not None:
            with contextlib.suppress(LogWriteError), self._errors(), file:
                file.flush()

    @contextlib.contextmanager
    def _opened(self) -> Iterator[BinaryIO]:
        """Yield the file, open; after an error nothing more is written."""
        self.check()
        with self._errors():
            if self._file is not None:
                yield self._file
            else:
                with open(os.open(self._path, os.O_WRONLY | os.O_APPEND), "ab") as file:
                    yield file

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        """Turn an error of the disk into one of the log, keep the first, and close the file."""
        try:
            yield
        except OSError as error:
            self._error = self._error or write_error(self._path, error)
            if not self.closed:
                self.close()
            raise self._error from error

    def _lock(self, file: BinaryIO) -> None:
        """Keep other processes from writing the file while it is open."""
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # Another process may have given it its final name since it was opened here.
            mine = os.path.samestat(os.stat(self._path), os.fstat(file.fileno()))
        except (BlockingIOError, FileNotFoundError):
            mine = False
        except OSError:
            mine = True  # a file system without locks: nothing can be held there
        if not mine:
            raise UsageError(
                f"{self._path} is being written by another process: wait for it, or choose another "
                "name"
            )


_STAY_OPEN: Final[WeakSet[AppendOnlyFile]] = WeakSet()


def write_error(path: Path, error: OSError) -> LogWriteError:
    """Return the error for a disk that does not take a file."""
    return LogWriteError(
        f"{path} cannot be written: {error.strerror or error}; "
        "check the free space and rights there, what was flushed is readable"
    )


class LogFile(McapWriter):
    """One MCAP file: chunked, indexed, with CRCs and repeated schemas and channels.

    As a context manager it finishes the file on success and leaves the flushed
    `.partial` on an exception. The same calls give the same bytes. Every method that writes raises
    a `LogWriteError` if the disk does not take it, or did not take something before.

    Attributes:
        path: the file's name once it is finished.
        partial: its name until then.
    """

    def __init__(
        self, path: Path, *, force: bool = False, flush_ns: int = FLUSH_NS, **options: Any
    ) -> None:
        """Open NAME.partial for writing.

        Args:
            path: the file's name once it is finished.
            force: overwrite an earlier file.
            flush_ns: log time after which it is flushed.
            options: of `McapWriter`.

        Raises:
            UsageError: the file or its partial exists and `force` is not set, another process
                writes it, or it is no file.
            LogWriteError: the file cannot be opened.
        """
        self.path = Path(path)
        self.partial = partial_path(self.path)
        self._force = force
        self._flush_ns = flush_ns
        self._chunk_start: int | None = None
        self._named_on_disk = False
        refuse_taken(self.path, force=force)
        refuse_taken(self.partial, force=force)
        self._stream = AppendOnlyFile(self.partial)
        try:
            super().__init__(self._stream, **options)
        except BaseException:
            self._stream.close()
            raise

    @property
    def closed(self) -> bool:
        """Whether the file was finished or abandoned."""
        return self._stream.closed

    def write(self, channel: int, log_time: int, data: bytes, sequence: int = 0) -> None:
        """Write a message that was published at its log time.

        Once `flush_ns` of log time have passed since the chunk began, it is flushed first.

        Args:
            channel: id from `add_channel`.
            log_time: nanoseconds.
            data: the encoded message.
            sequence: the publisher's counter.
        """
        self.write_all(((channel, log_time, data, log_time, sequence),))

    def write_all(self, messages: Sequence[tuple[int, int, bytes, int, int]]) -> None:
        """Write messages that are flushed together, at least one.

        Args:
            messages: channel, log time, data, publish time and sequence of each, as `write` says.
        """
        self._stream.check()
        log_time = messages[0][1]
        if self._chunk_start is None:
            self._chunk_start = log_time
        elif log_time - self._chunk_start >= self._flush_ns:
            self.flush()
            self._chunk_start = log_time
        self.add_messages(messages)

    def flush(self) -> None:
        """Close the chunk in progress and hand everything to the operating system."""
        self._stream.check()
        self._chunk_start = None
        self.end_chunk()
        self.settle()
        self._stream.flush()

    def sync(self) -> None:
        """Flush, and let the disk have everything: a power cut takes nothing of it."""
        self.flush()
        self._stream.sync()
        if not self._named_on_disk:
            self._rename(self.partial)  # to the same name, which only syncs it
            self._named_on_disk = True

    def finish(self) -> None:
        """Write the index, make the file durable and give it its name.

        Raises:
            UsageError: a file of that name appeared meanwhile; the `.partial` stays.
        """
        try:
            self._stream.check()
            self.end()
            self._stream.sync()
        finally:
            self._stream.close()
        if not self._force and self.path.exists():
            raise UsageError(
                f"{self.path} appeared while it was being written: "
                f"the new log is whole in {self.partial.name}, rename it"
            )
        self._rename(self.path)

    def abandon(self) -> None:
        """Flush what can be flushed and close, leaving a readable `.partial`."""
        if not self.closed:
            with contextlib.suppress(LogWriteError):
                self.sync()
            self._stream.close()

    def _rename(self, name: Path) -> None:
        """Give the file a name, also on the disk."""
        try:
            os.replace(self.partial, name)
            to_disk(name.parent)
        except OSError as error:
            raise write_error(self.path, error) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            self.abandon()
        elif not self.closed:
            self.finish()
