"""`LogReader`: strict reader of any MCAP file, complete or cut, with or without an index.

It returns every message in file order, and none whose checksum does not match. Memory holds a few
chunks.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final, Literal, Self

import numpy as np
from mcap.records import Channel, Schema, Statistics

from cdmisfa.core.errors import LogDamagedError
from recorder.mcap.chunks import Chunks, MessageTable, Pairs
from recorder.mcap.records import (
    CHUNK_PEEK,
    MAX_CHUNK,
    RECORD_HEADER,
    Attachment,
    MalformedRecord,
    Message,
    Segment,
    crc32,
)
from recorder.mcap.store import Store
from recorder.mcap.walk import LogStructure

Check = Literal["chunks", "data", "pass"]

NO_CHECKSUMS: Final = "it has no checksums, so that changed bytes cannot be noticed"


class LogReader(LogStructure):
    """An MCAP file, read by its content and not by the claims of its index.

    Damage raises an error with the file, the chunk and its time range. With `skip_damaged` the
    damaged chunk is skipped and noted in `problems`, and the part of a cut last chunk that can be
    decoded is read too, unverified.

    If the summary accounts for every message, only the requested chunks are read and checked. The
    checksum over all data is checked if all of it is read (`check`, `sha256`), or a chunk has no
    checksum of its own.
    """

    def __init__(
        self, log: str | Path | Store, *, skip_damaged: bool = False, check: Check | None = None
    ) -> None:
        """Open a log.

        Args:
            log: path of a file, or its store, which is closed with the reader.
            skip_damaged: True to skip damaged parts.
            check: "chunks" trusts a summary that accounts for every message; "data" reads every
                record, and the checksum over the data; "pass" leaves the checksum to `one_pass`.
                None: "chunks", or "data" with `skip_damaged`.

        Raises:
            UsageError: the file cannot be opened.
            LogDamagedError: it is not an MCAP file, or its structure is damaged.
        """
        self._failed: set[int] = set()
        self._defined = self._searched = self._checked = False
        if not isinstance(log, Store):
            log = Store(Path(log))
        check = check or ("data" if skip_damaged else "chunks")
        try:
            super().__init__(log, skip_damaged=skip_damaged, by_index=check == "chunks")
            note = None if check == "chunks" else self.note
            self._chunks = Chunks(log, self.definitions, note, self._check_unproven)
            if self.torn is not None and self.torn in self.segments:
                # The header of a chunk that was still being written states no times yet.
                table = self.table(self.torn)
                if table is not None and len(table):
                    times = table.log_time
                    self.torn.start, self.torn.end = int(times.min()), int(times.max())
            if not self.by_index and check != "pass":
                self._check_data()
        except BaseException as error:
            log.close()
            if isinstance(error, MalformedRecord):
                raise LogDamagedError(f"{log.path}: {error}") from None
            raise

    # Content of the file

    @property
    def statistics(self) -> Statistics | None:
        """Statistics in the summary, or None."""
        return self.summary.statistics if self.summary else None

    @property
    def warnings(self) -> list[str]:
        """Missing, skipped and unprotected parts, one line for each with the path of the file."""
        problems = [f"{p.where}: {p.what}" for p in self.problems]
        lines = (f"{self.path}: {text}" for text in (self.missing, *problems) if text)
        return [*lines, *self.unproven()]

    def unproven(self) -> list[str]:
        """Return a line with the path if the file has no checksums."""
        return [f"{self.path}: {NO_CHECKSUMS}"] if self.crc_absent() else []

    @property
    def channels(self) -> Mapping[int, Channel]:
        """All channels of the file; reads chunks if nothing else defines the channels."""
        self._define()
        return self.definitions.channels

    @property
    def schemas(self) -> Mapping[int, Schema]:
        """All schemas of the file; reads chunks if nothing else defines the schemas."""
        self._define()
        return self.definitions.schemas

    def attachment_data(self, attachment: Attachment) -> bytes:
        """Return an attachment's bytes; raise a LogDamagedError if they are too large."""
        if attachment.size > MAX_CHUNK:
            raise LogDamagedError(
                f"{self.path}: attachment {attachment.name[:80]!r} has {attachment.size} bytes, "
                f"above the limit of {MAX_CHUNK}: read it with another tool"
            )
        return self.file.read(attachment.offset, attachment.size)

    def crc_absent(self) -> int:
        """Return the number of segments without a checksum.

        For a file that was opened by its index and has no checksum over all data, only the first
        chunk is tested: reading the header of each would take as long as reading the file.
        """
        if self.data_crc:
            return 0
        segments = self.segments
        if self.by_index:
            places = [s.offset + RECORD_HEADER.size for s in segments[:1]]
            segments = [Segment.of_chunk(p, self.file.peek(p, CHUNK_PEEK)) for p in places]
        return sum(1 for s in segments if s.crc == 0 and s.size)

    def sha256(self, counted: Callable[[int], None] = lambda count: None) -> str:
        """Return the SHA-256 of the file, and check the checksum over all data at the same time.

        Args:
            counted: called with the size of each hashed block (bytes).
        """
        sha256, crc, at = hashlib.sha256(), 0, 0
        end = self.data_end if self.data_crc else 0
        for block in self.file.blocks(0, self.file.size):
            sha256.update(block)
            crc = crc32(block[: max(end - at, 0)], crc)
            at += len(block)
            counted(len(block))
        self._check_data(crc)
        return sha256.hexdigest()

    def tail(self) -> Iterator[bytes]:
        """Yield the bytes from the data end record on, if the file was opened by its index."""
        if self.by_index:
            yield from self.file.blocks(self.data_end, self.file.size)

    # Messages

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        """Yield the messages in file order.

        Args:
            topics: topics to select; None: all.

        Raises:
            LogDamagedError: without `skip_damaged`, at the first damage.
        """
        for segment, table in self.tables(topics=topics):
            known = {c: self._channel(c, segment) for c in np.unique(table.channel).tolist()}
            selected = {
                c: k for c, k in known.items() if k and (topics is None or k.topic in topics)
            }
            if len(selected) < len(known):
                table = table.select(np.isin(table.channel, list(selected)))
            for number, sequence, log_time, published, data in table.rows():
                yield Message(selected[number], sequence, log_time, published, data)

    def tables(
        self, *, start: int = 0, topics: Collection[str] | None = None
    ) -> Iterator[tuple[Segment, MessageTable]]:
        """Yield the messages as one table for each chunk, in file order.

        Chunks that end before log time `start` (ns) are skipped, and for a log that was opened by
        its index those without any of `topics`.

        Raises:
            LogDamagedError: without `skip_damaged`, at the first damage.
        """
        chosen = [s for s in self.segments if s.end >= start]
        if self.by_index:
            numbers = {c for c, k in self.channels.items() if topics is None or k.topic in topics}
            chosen = [s for s in chosen if numbers & (s.channel_counts() or {}).keys()]
        self.expect(chosen)
        for segment in chosen:
            table = self.table(segment)
            if table is not None:
                yield segment, table.select(table.log_time >= np.uint64(start)) if start else table

    def one_pass(self) -> Iterator[tuple[Segment, MessageTable | None]]:
        """Yield every chunk in file order, with None for a damaged one that is skipped.

        Open the log with check "pass" for this, which leaves the checksum over all data to this
        method.

        Raises:
            LogDamagedError: without `skip_damaged`, at the first damage.
        """
        crc = at = 0
        self.file.keep_reads()
        for segment in self.segments:
            yield segment, self.table(segment)
            crc, at = self.file.crc(at, segment.stop, crc), segment.stop
        self._check_data(self.file.crc(at, self.data_end, crc))

    def expect(self, segments: Sequence[Segment], *, indexes: bool = False) -> None:
        """Announce the chunks, or only their indexes, that will be read one after the other."""
        self._chunks.expect(() if indexes else segments)
        spans = ((s.data_end if indexes else s.offset, s.stop) for s in segments)
        self.file.expect(list(spans))

    def table(self, segment: Segment) -> MessageTable | None:
        """Decode and check a chunk; the last few stay in a cache.

        Returns:
            The messages in file order; None if the chunk is damaged and `skip_damaged` is set.

        Raises:
            LogDamagedError: without `skip_damaged`, the chunk is damaged.
        """
        if self.skip_damaged and segment.offset in self._failed:
            return None
        try:
            return self._chunks.table(segment)
        except MalformedRecord as error:
            self._failed.add(segment.offset)
            if not (segment.cut and self.skip_damaged):  # `missing` describes a cut chunk
                self.refuse(segment.name, str(error))
            return None

    def index(self, segment: Segment, channels: Collection[int] | None = None) -> Pairs:
        """Read a chunk's message indexes, or those of some channels.

        Raises:
            LogDamagedError: the indexes are larger than any chunk.
        """
        try:
            return self._chunks.index(segment, channels)
        except MalformedRecord as error:
            raise LogDamagedError(f"{self.path}: {segment.name}: {error}") from None

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        self._chunks.close()
        self.file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # Internals

    def _check_data(self, crc: int | None = None) -> None:
        """Compare the checksum over all data with the data, once.

        Args:
            crc: CRC of the data if they were read already; None: read them now.
        """
        if not self.data_crc or self._checked:
            return
        self._checked = True
        if (self.file.crc(0, self.data_end) if crc is None else crc) != self.data_crc:
            if not self.skip_damaged:
                self._search()  # raises an error that names the damaged chunk, if it has a CRC
            self.refuse("data section", "its CRC does not match: damaged")

    def _check_unproven(self) -> None:
        """Check all data if a chunk has no checksum of its own."""
        if self.by_index:
            self._check_data()

    def _channel(self, number: int, segment: Segment) -> Channel | None:
        """Return the channel of messages in a chunk; some writers define it in a later chunk."""
        for search in (False, True):
            if search:
                self._search()
            channel = self.definitions.channels.get(number)
            schemas = {0, *self.definitions.schemas}
            if channel and channel.schema_id in schemas:
                return channel
        problem = f"it has messages of channel {number}, which is not defined"
        if channel is not None:
            problem = f"schema {channel.schema_id} of {channel.topic!r} is not defined"
        self.refuse(segment.name, problem)
        return channel

    def _define(self) -> None:
        """Decode chunks until every channel with messages is defined."""
        if self._defined:
            return
        known, counted = self.definitions.channels, set[int]()
        # A trusted summary defines every channel whose messages it counts.
        for segment in () if self.by_index else self.segments:
            counts = segment.channel_counts()
            if counts is None or not counts.keys() <= known.keys():
                self.table(segment)
            counted.update(counts or ())
        self._defined = True
        schemas = {0, *self.definitions.schemas}
        if not (counted <= known.keys() and {c.schema_id for c in known.values()} <= schemas):
            self._search()

    def _search(self) -> None:
        """Decode every chunk: a definition can be in a chunk without messages of its channel."""
        if not self._searched:
            self._searched = True
            for segment in self.segments:
                self.table(segment)
            if self._limit is None and self.data_crc is not None:
                self._define_behind_data()
