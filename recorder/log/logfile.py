"""MCAP files that stay readable after a crash.

A `LogFile` is called NAME.partial until it is finished, so that a file called NAME is complete. It
is readable up to the last flush after an error, a signal, kill -9 or a full disk, and up to the
last `sync` after a power cut.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO, Final, Self

from cdmisfa.core.errors import LogWriteError, UsageError
from recorder.log.files import partial_path, refuse_taken, to_disk
from recorder.mcap.writer import McapWriter

# Default log time after which the present chunk is passed to the operating system. A shorter time
# loses less after a kill, and makes more and smaller chunks.
#
# A run's log flushes by wall time instead (`replay/runs/writer.py`).
FLUSH_NS: Final = 1_000_000_000


class AppendOnlyFile:
    """Binary file that only grows, and refuses all writes after one has failed.

    The MCAP writer would continue after a failed write, and leave a hole in the log.

    It is locked against other processes while it is open.
    """

    def __init__(self, path: Path) -> None:
        """Create an empty file.

        Raises:
            UsageError: another process is writing the file.
            LogWriteError: the file cannot be opened.
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
                if os.fstat(file.fileno()).st_size:  # a device such as /dev/full has no size
                    file.truncate()
            except BaseException:
                file.close()
                raise
            self._file = file

    def check(self) -> None:
        """Raise a LogWriteError if a write has failed, or the file is closed."""
        if self._error is not None:
            raise LogWriteError(str(self._error)) from self._error
        if self.closed:
            raise LogWriteError(f"{self._path}: this log is closed, nothing more can be written")

    def write(self, data: bytes | memoryview) -> int:
        """Append the bytes, and return their number."""
        with self._opened() as file:
            self._size += file.write(data)
        return len(data)

    def tell(self) -> int:
        """Return the number of appended bytes."""
        return self._size

    def flush(self) -> None:
        """Pass all written bytes to the operating system."""
        with self._opened() as file:
            file.flush()

    def sync(self) -> None:
        """Write all bytes to the disk."""
        with self._opened() as file:
            file.flush()
            os.fsync(file.fileno())

    def close(self) -> None:
        """Close the file; ignore an error of it, which repeats that of an earlier write."""
        self.closed = True
        file, self._file = self._file, None
        if file is not None:
            with contextlib.suppress(LogWriteError), self._errors(), file:
                file.flush()

    @contextlib.contextmanager
    def _opened(self) -> Iterator[BinaryIO]:
        """Yield the open file; raise the error of an earlier write."""
        self.check()
        assert self._file is not None
        with self._errors():
            yield self._file

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        """Convert the first OSError to a LogWriteError, remember it, and close the file."""
        try:
            yield
        except OSError as error:
            self._error = self._error or write_error(self._path, error)
            if not self.closed:
                self.close()
            raise self._error from error

    def _lock(self, file: BinaryIO) -> None:
        """Lock the file against other processes while it is open."""
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # Another process may have renamed the file after it was opened here.
            mine = os.path.samestat(os.stat(self._path), os.fstat(file.fileno()))
        except (BlockingIOError, FileNotFoundError):
            mine = False
        except OSError:
            mine = True  # this file system has no locks
        if not mine:
            raise UsageError(f"{self._path} is being written by another process: wait for it")


def write_error(path: Path, error: OSError) -> LogWriteError:
    """Return the error for a file that cannot be written."""
    return LogWriteError(
        f"{path} cannot be written: {error.strerror or error}; "
        "check the free space and rights there; flushed data stay readable"
    )


class LogFile(McapWriter):
    """MCAP file: chunked, indexed, with CRCs and repeated schemas and channels.

    As a context manager it finishes the file on success, and leaves the readable `.partial` after
    an exception. The same calls give the same bytes. Every method that writes raises a
    `LogWriteError` if this write or an earlier one fails.

    Attributes:
        path: name of the finished file.
        partial: name until then.
    """

    def __init__(
        self, path: Path, *, force: bool = False, flush_ns: int = FLUSH_NS, **options: Any
    ) -> None:
        """Create NAME.partial.

        Args:
            path: name of the finished file.
            force: True to overwrite an earlier file.
            flush_ns: log time after which the file is flushed (ns).
            options: arguments of `McapWriter`.

        Raises:
            UsageError: the file or its partial exists and `force` is not set, another process is
                writing it, or it is a device.
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
        """Write a message whose publish time is its log time.

        The present chunk is flushed first if `flush_ns` of log time have passed since it began.

        Args:
            channel: id from `add_channel`.
            log_time: log time (ns).
            data: the encoded message.
            sequence: sequence number.
        """
        self.write_all(((channel, log_time, data, log_time, sequence),))

    def write_all(self, messages: Sequence[tuple[int, int, bytes, int, int]]) -> None:
        """Write messages that are flushed together, at least one.

        Args:
            messages: channel, log time, data, publish time and sequence number of each.
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
        """End the present chunk, and pass all bytes to the operating system."""
        self._stream.check()
        self._chunk_start = None
        self.end_chunk()
        self._stream.flush()

    def sync(self) -> None:
        """Flush, and write all bytes to the disk, so that a power cut does not lose them."""
        self.flush()
        self._stream.sync()
        if not self._named_on_disk:
            self._rename(self.partial)  # to the same name, which only syncs it
            self._named_on_disk = True

    def finish(self) -> None:
        """Write the index, sync the file, and give it its final name.

        Raises:
            UsageError: a file with that name was created meanwhile; the `.partial` stays.
        """
        try:
            self._stream.check()
            self.end()
            self._stream.sync()
        finally:
            self._stream.close()
        if not self._force and self.path.exists():
            raise UsageError(
                f"{self.path} was created by another program meanwhile: "
                f"the new log is complete in {self.partial.name}: rename it"
            )
        self._rename(self.path)

    def abandon(self) -> None:
        """Flush if possible, and close; the `.partial` stays readable."""
        if not self.closed:
            with contextlib.suppress(LogWriteError):
                self.sync()
            self._stream.close()

    def _rename(self, name: Path) -> None:
        """Rename the file, and sync the name to the disk."""
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
