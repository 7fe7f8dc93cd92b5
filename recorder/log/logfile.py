"""Writing an MCAP file that survives what happens to it.

A `LogFile` is `NAME.partial` until it is finished, so a file called NAME is always
whole. What was written is readable up to the last flush after any end: an error, a
signal, kill -9, a full disk; after a power cut up to the last `sync`.
"""

from __future__ import annotations

import contextlib
import math
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Self

from cdmisfa.core.errors import LogWriteError, UsageError
from recorder.config import Compression
from recorder.log.appended import AppendedFile, write_error
from recorder.log.folder import refuse_held
from recorder.log.whole import partial_path, refuse_special, refuse_taken, to_disk
from recorder.mcap.writer import McapWriter

FLUSH_NS = 1_000_000_000
"""Log time after which the chunk in progress is handed to the operating system, by default.

A run's log flushes by wall time (`replay/runs/writer.py`).
"""


class LogFile:
    """One MCAP file: chunked, indexed, with CRCs and repeated schemas and channels.

    As a context manager it finishes the file on success and leaves the flushed
    `.partial` on an exception. The same calls give the same bytes. What writes raises a
    `LogWriteError` where the disk does not take it, or did not take something before.

    Attributes:
        path: the file's name once it is finished.
        partial: its name until then.
    """

    def __init__(
        self,
        path: Path,
        *,
        force: bool = False,
        library: str = "cdmisfa",
        profile: str = "",
        compression: Compression = "zstd",
        chunk_size: int = 1024 * 1024,
        flush_ns: int = FLUSH_NS,
        fsync_every: float | None = None,
        aside: bool = False,
    ) -> None:
        """Open NAME.partial for writing.

        Args:
            path: the file's name once it is finished.
            force: overwrite what is there.
            library: what wrote it, as the header states.
            profile: of the messages, as the header states.
            compression: of the chunks.
            chunk_size: bytes of messages at which a chunk is closed.
            flush_ns: log time after which it is flushed.
            fsync_every: seconds of wall time after which a flush lets the disk have everything,
                too; None leaves that to the operating system until the end. The bytes are the same.
            aside: compress in a thread of its own; the bytes are the same.

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
        self._fsync_every = math.inf if fsync_every is None else fsync_every
        self._next_sync = time.monotonic() + self._fsync_every
        self._named_on_disk = False
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        refuse_taken(self.path, force=force)
        refuse_special(self.partial)
        if self.partial.exists():
            if not force:
                raise UsageError(
                    f"{self.partial} is left from a writing that was cut short: "
                    "recover or remove it, or overwrite with --force"
                )
            refuse_held(self.partial.parent)
        self._stream = AppendedFile(self.partial)
        try:
            self._writer = McapWriter(
                self._stream,
                library=library,
                profile=profile,
                compression=compression,
                chunk_size=chunk_size,
                aside=aside,
            )
        except BaseException:
            self._stream.close()
            raise

    @property
    def closed(self) -> bool:
        """Whether the file was finished or abandoned."""
        return self._stream.closed

    @property
    def size(self) -> int:
        """Bytes written so far; the chunk in progress is not among them."""
        self._writer.settle()
        return self._stream.tell()

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Register a message schema, and return its id; the same schema gets the same."""
        key = (name, encoding, data)
        if key not in self._schemas:
            self._schemas[key] = self._writer.add_schema(name, encoding, data)
        return self._schemas[key]

    def add_channel(
        self,
        topic: str,
        schema: int,
        *,
        encoding: str = "protobuf",
        metadata: Mapping[str, str] | None = None,
    ) -> int:
        """Register a channel of messages on a topic, and return its id; schema 0 is none."""
        return self._writer.add_channel(topic, encoding, schema, metadata or {})

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a named string map at once, outside the chunks."""
        self._writer.add_metadata(name, values)
        self._stream.flush()

    def add_attachment(
        self, name: str, media_type: str, data: bytes, *, log_time: int = 0, create_time: int = 0
    ) -> None:
        """Write a named file at once, outside the chunks; times in nanoseconds."""
        self._writer.add_attachment(
            name, media_type, data, log_time=log_time, create_time=create_time
        )
        self._stream.flush()

    def write(
        self,
        channel: int,
        log_time: int,
        data: bytes,
        sequence: int = 0,
        publish_time: int | None = None,
    ) -> None:
        """Write a message.

        Once `flush_ns` of log time have passed since the chunk began, it is flushed first.

        Args:
            channel: id from `add_channel`.
            log_time: nanoseconds.
            data: the encoded message.
            sequence: the publisher's counter.
            publish_time: nanoseconds; the log time where none is given.
        """
        published = log_time if publish_time is None else publish_time
        self.write_all(((channel, log_time, data, published, sequence),))

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
        self._writer.add_messages(messages)

    def flush(self) -> None:
        """Close the chunk in progress and hand everything to the operating system."""
        self._stream.check()
        self._chunk_start = None
        self._writer.end_chunk()
        self._writer.settle()
        self._stream.flush()
        if time.monotonic() >= self._next_sync:
            self._sync()

    def sync(self) -> None:
        """Flush, and let the disk have everything: a power cut takes nothing of it."""
        self.flush()
        self._sync()

    def _sync(self) -> None:
        self._stream.sync()
        if not self._named_on_disk:
            with self._telling():
                to_disk(self.partial.parent)
            self._named_on_disk = True
        self._next_sync = time.monotonic() + self._fsync_every

    def finish(self) -> None:
        """Write the index, make the file durable and give it its name.

        Raises:
            UsageError: a file of that name appeared meanwhile; the `.partial` stays.
        """
        try:
            self._stream.check()
            self._writer.finish()
            self._stream.sync()
        finally:
            self._stream.close()
        if not self._force and self.path.exists():
            raise UsageError(
                f"{self.path} appeared while it was being written: "
                f"the new log is whole in {self.partial.name}, rename it"
            )
        with self._telling():
            os.replace(self.partial, self.path)
            to_disk(self.path.parent)

    def abandon(self) -> None:
        """Flush what can be flushed and close, leaving a readable `.partial`."""
        if self.closed:
            return
        with contextlib.suppress(LogWriteError):
            self.sync()
        self._stream.close()

    @contextlib.contextmanager
    def _telling(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise write_error(self.path, error) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            self.abandon()
        elif not self.closed:
            self.finish()
